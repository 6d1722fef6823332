/* The clock, the ticks on the output pins and the stamps of exposures: all that Timer1 does. */
#ifndef TRAIN_H
#define TRAIN_H

#include <stdint.h>

#include "code.h"

#define CYCLES_PER_US 16

struct train {
    uint32_t millihertz;
    uint32_t ticks;   /* 0 is without end */
    uint8_t all;      /* report ticks with bit 0 too */
    struct coder coder;
};
struct tick {
    uint32_t number;
    uint64_t cycles;
    uint8_t bit;
};
struct exposure {
    uint32_t number;
    uint64_t cycles;
};

void train_init(void);

/* Cycles since power came. */
uint64_t clock_now(void);

/* Forget the train before and all its reports; it must not run any more. */
void train_arm(const struct train *train);

/* Begin, and return the time of tick 0 in cycles: a little ahead, and a whole microsecond. */
uint64_t train_go(void);

/* End behind the pulse that is being sent, or behind one whose edge is set up already. */
void train_stop(void);

uint8_t train_runs(void);
uint32_t train_ticks_sent(void); /* of the last train, once it runs no more */

/* Reports, oldest first; 0 if there is none. What finds no room is dropped, and counted. */
uint8_t train_tick(struct tick *tick);
uint8_t train_exposure(struct exposure *exposure);
uint8_t train_reports_wait(void);
uint32_t train_dropped(void);

#endif

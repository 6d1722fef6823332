/* Timer1 counts cycles (16 MHz) and never stops. Its compare unit toggles the output pins, so every
 * edge is exact to the cycle whatever the processor is doing; the interrupt behind an edge only
 * sets up the next one. Its capture unit stamps exposures in the same way.
 */
#include "train.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "pins.h"

#define LONGEST_PULSE 80000UL /* 5 ms: an arm that looks every 2 ms or 4 ms sees it */
#define LEAD 32000            /* from GO to tick 0: time to answer before the first report */
#define WAYPOINT 0x8000UL
#define CYCLES_PER_KILOSECOND 16000000000ULL
#define QUEUE 32

/* -- clock ------------------------------------------------------------------------------------ */

static volatile uint32_t wraps; /* of the timer; with its 16 bits the clock lasts 203 days */

ISR(TIMER1_OVF_vect)
{
    wraps++;
}

/* Cycles since power came, at a count that the timer showed a moment ago; interrupts are off. */
static uint64_t cycles_at(uint16_t count)
{
    uint32_t w = wraps;
    if ((TIFR1 & _BV(TOV1)) && count < 0x8000)
        w++; /* it wrapped before that count and the interrupt has not been served yet */
    return (uint64_t)w << 16 | count;
}

uint64_t clock_now(void)
{
    uint64_t cycles;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        cycles = cycles_at(TCNT1);
    }
    return cycles;
}

/* -- reports, from interrupts to the main loop ------------------------------------------------ */

static volatile struct tick ticks[QUEUE];
static volatile struct exposure exposures[QUEUE];
static volatile uint8_t ticks_in, ticks_out, exposures_in, exposures_out;
static volatile uint32_t dropped;
static volatile uint32_t exposures_seen;
static volatile uint8_t listening; /* to exposures, from GO to ARM */

/* Always on, so that no old stamp waits for the day when somebody listens. */
ISR(TIMER1_CAPT_vect)
{
    uint64_t cycles = cycles_at(ICR1);
    if (!listening)
        return;
    uint32_t number = exposures_seen++;
    uint8_t next = (exposures_in + 1) % QUEUE;
    if (next == exposures_out) {
        dropped++;
        return;
    }
    exposures[exposures_in].number = number;
    exposures[exposures_in].cycles = cycles;
    exposures_in = next;
}

uint8_t train_tick(struct tick *tick)
{
    if (ticks_in == ticks_out)
        return 0;
    *tick = ticks[ticks_out];
    ticks_out = (ticks_out + 1) % QUEUE;
    return 1;
}

uint8_t train_exposure(struct exposure *exposure)
{
    if (exposures_in == exposures_out)
        return 0;
    *exposure = exposures[exposures_out];
    exposures_out = (exposures_out + 1) % QUEUE;
    return 1;
}

uint8_t train_reports_wait(void)
{
    return ticks_in != ticks_out || exposures_in != exposures_out;
}

uint32_t train_dropped(void)
{
    uint32_t n;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        n = dropped;
    }
    return n;
}

/* -- the train -------------------------------------------------------------------------------- */

static struct train train;
static uint32_t period, rest; /* in cycles, and what its division by the rate leaves */
static uint32_t width;
static volatile uint8_t running, stopping;
static volatile uint32_t ticks_sent;
static uint64_t edge_cycles; /* of the edge to come or just gone */
static uint32_t remaining;   /* cycles from the match that is set up to the edge */
static uint32_t carried;     /* of `rest`, to spread it over the ticks */
static uint8_t bit, high;

/* Set up the next match: the edge if the timer can count that far, else a point on the way. */
static inline void set_up(uint16_t from)
{
    uint16_t step = remaining > UINT16_MAX ? WAYPOINT : remaining;
    remaining -= step;
    OCR1A = from + step;
    OCR1B = from + step;
    if (remaining == 0)
        TCCR1A = bit ? _BV(COM1A0) | _BV(COM1B0) : _BV(COM1A0);
}

static inline void report_tick(void)
{
    uint32_t number = ticks_sent++;
    if (!bit && !train.all)
        return;
    uint8_t next = (ticks_in + 1) % QUEUE;
    if (next == ticks_out) {
        dropped++;
        return;
    }
    ticks[ticks_in].number = number;
    ticks[ticks_in].cycles = edge_cycles;
    ticks[ticks_in].bit = bit;
    ticks_in = next;
}

ISR(TIMER1_COMPA_vect)
{
    if (!running)
        return;
    if (remaining) { /* on the way */
        if (stopping && !high)
            running = 0;
        else
            set_up(OCR1A);
        return;
    }
    /* The timer has made the edge. The ports hold the level while the timer is let go of them. */
    high = !high;
    if (high)
        OUTPUT_PORT |= bit ? TRIGGER | CODE : TRIGGER;
    else
        OUTPUT_PORT &= ~(TRIGGER | CODE);
    TCCR1A = 0;
    if (high) {
        remaining = width;
        set_up(OCR1A);
        report_tick();
        edge_cycles += width;
        return;
    }
    if (stopping || ticks_sent == train.ticks) { /* one was sent, so 0 is without end */
        running = 0;
        return;
    }
    uint32_t low = period - width;
    carried += rest;
    if (carried >= train.millihertz) {
        carried -= train.millihertz;
        low++;
    }
    bit = code_next(&train.coder);
    remaining = low;
    set_up(OCR1A);
    edge_cycles += low;
}

void train_arm(const struct train *armed)
{
    train = *armed;
    period = CYCLES_PER_KILOSECOND / train.millihertz;
    rest = CYCLES_PER_KILOSECOND % train.millihertz;
    width = period / 2 < LONGEST_PULSE ? period / 2 : LONGEST_PULSE;
    carried = 0;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        listening = 0;
        ticks_in = ticks_out = exposures_in = exposures_out = 0;
        ticks_sent = dropped = exposures_seen = 0;
    }
}

uint64_t train_go(void)
{
    uint64_t first;
    ATOMIC_BLOCK(ATOMIC_FORCEON)
    {
        OCR1A = TCNT1 - 1; /* just gone by: no match comes for 4 ms */
    }
    __asm__ volatile("nop"); /* a match that came before is served here and ignored */
    ATOMIC_BLOCK(ATOMIC_FORCEON)
    {
        first = (cycles_at(TCNT1) + LEAD) / CYCLES_PER_US * CYCLES_PER_US;
        edge_cycles = first;
        bit = code_next(&train.coder);
        high = stopping = 0;
        running = listening = 1;
        remaining = LEAD;
        set_up((uint16_t)first - 1 - LEAD); /* an output changes one cycle after its match */
    }
    return first;
}

void train_stop(void)
{
    stopping = 1;
}

uint8_t train_runs(void)
{
    return running;
}

uint32_t train_ticks_sent(void)
{
    return ticks_sent;
}

void train_init(void)
{
    OUTPUT_PORT = EXPOSURE; /* its pull-up: an input that is not wired stays quiet */
    OUTPUT_DIRECTION = TRIGGER | CODE;
    TCCR1B = _BV(ICNC1) | _BV(ICES1) | _BV(CS10);
    TIMSK1 = _BV(TOIE1) | _BV(OCIE1A) | _BV(ICIE1);
}

/* Sync box of SlipLab: ticks, a coded pulse train, exposure stamps, and one clock for all three.
 *
 * Timer1 counts cycles (16 MHz) and never stops. Its compare unit toggles the output pins, so every
 * edge is exact to the cycle whatever the processor is doing; an interrupt behind each edge only
 * sets up the next one. Its capture unit stamps exposures in the same way. The protocol stands in
 * docs/sync-box.md and is told here, in `obey` and `report`.
 *
 * There is no watchdog: old bootloaders of the Nano hang after a watchdog reset. A box that hangs
 * is silent, and the host notices silence.
 */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <stdlib.h>
#include <string.h>
#include <util/atomic.h>

#include "code.h"
#include "line.h"
#include "pins.h"

#define NAME "sliplab-sync-box 1" /* the number is the protocol's */

#define CYCLES_PER_US 16
#define LONGEST_PULSE 80000UL /* 5 ms: an arm that looks every 2 ms or 4 ms sees it */
#define LEAD 32000 /* from GO to tick 0: time to answer before the first report */
#define WAYPOINT 0x8000UL
#define LEAST_MILLIHERTZ 1000UL
#define MOST_MILLIHERTZ 1000000UL
#define ALL_TO_MILLIHERTZ 200000UL /* up to here ticks with bit 0 are reported too */
#define CYCLES_PER_KILOSECOND 16000000000ULL
#define QUEUE 32
#define PATIENCE 64 /* reports until it is told how many were dropped, in a full queue */

/* -- clock ------------------------------------------------------------------------------------ */

static volatile uint32_t wraps; /* of the timer; with its 16 bits the clock lasts 203 days */

ISR(TIMER1_OVF_vect)
{
    wraps++;
}

/* Cycles since the start at a count that the timer showed a moment ago; interrupts are off. */
static uint64_t cycles_at(uint16_t count)
{
    uint32_t w = wraps;
    if ((TIFR1 & _BV(TOV1)) && count < 0x8000)
        w++; /* it wrapped before that count and the interrupt has not been served yet */
    return (uint64_t)w << 16 | count;
}

static uint64_t now(void)
{
    uint64_t cycles;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        cycles = cycles_at(TCNT1);
    }
    return cycles;
}

/* -- reports, from interrupts to the main loop ------------------------------------------------ */

struct tick {
    uint32_t number;
    uint64_t cycles;
    uint8_t bit;
};
struct exposure {
    uint32_t number;
    uint64_t cycles;
};
static volatile struct tick ticks[QUEUE];
static volatile struct exposure exposures[QUEUE];
static volatile uint8_t ticks_in, ticks_out, exposures_in, exposures_out;
static volatile uint32_t dropped; /* reports without room, since the last ARM */
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

/* -- the train -------------------------------------------------------------------------------- */

static struct {
    uint32_t millihertz, period, rest; /* period in cycles, and what division by the rate leaves */
    uint32_t width;
    uint32_t last; /* how many ticks; 0 is without end */
    uint8_t all;   /* report ticks with bit 0 too */
} plan;
static struct coder coder;
static volatile uint8_t running, stopping;
static volatile uint32_t ticks_sent;
static uint64_t edge_cycles; /* of the edge to come or just gone */
static uint32_t remaining;   /* cycles from the match set up now to the edge */
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
    if (!bit && !plan.all)
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
        remaining = plan.width;
        set_up(OCR1A);
        report_tick();
        edge_cycles += plan.width;
        return;
    }
    if (stopping || ticks_sent == plan.last) { /* never 0 here: a tick has been sent */
        running = 0;
        return;
    }
    uint32_t low = plan.period - plan.width;
    carried += plan.rest;
    if (carried >= plan.millihertz) {
        carried -= plan.millihertz;
        low++;
    }
    bit = code_next(&coder);
    remaining = low;
    set_up(OCR1A);
    edge_cycles += low;
}

static uint64_t first_cycles; /* of tick 0 */

static void go(void)
{
    ATOMIC_BLOCK(ATOMIC_FORCEON)
    {
        OCR1A = TCNT1 - 1; /* just gone by: no match comes for 4 ms */
    }
    __asm__ volatile("nop"); /* a match that came before is served here and ignored */
    ATOMIC_BLOCK(ATOMIC_FORCEON)
    {
        /* a whole microsecond, so that reports of round rates are exact */
        edge_cycles = (cycles_at(TCNT1) + LEAD) / CYCLES_PER_US * CYCLES_PER_US;
        first_cycles = edge_cycles;
        bit = code_next(&coder);
        high = stopping = 0;
        running = 1;
        remaining = LEAD;
        /* an output changes one cycle after its match */
        set_up((uint16_t)edge_cycles - 1 - LEAD);
        listening = 1;
    }
}

/* -- commands --------------------------------------------------------------------------------- */

static uint8_t armed, stop_asked;

static void fail(const char *why)
{
    put_text(PSTR("E "));
    put_text(why);
    put_end();
}

/* A rate in thousandths of a hertz from text with at most three decimals; 0 if it is none. */
static uint32_t millihertz(char *text)
{
    char *rest;
    uint32_t value = strtoul(text, &rest, 10);
    if (rest == text || value > MOST_MILLIHERTZ / 1000)
        return 0;
    uint8_t decimals = 0;
    if (*rest == '.')
        for (rest++; *rest >= '0' && *rest <= '9' && decimals < 3; rest++, decimals++)
            value = value * 10 + (*rest - '0');
    for (; decimals < 3; decimals++)
        value *= 10;
    return *rest ? 0 : value;
}

/* "hz seed n code" */
static void arm(char *text)
{
    char *hz = strsep(&text, " "), *seed = strsep(&text, " "), *n = strsep(&text, " ");
    uint32_t rate = millihertz(hz), start = seed ? strtoul(seed, NULL, 10) : 0;
    enum code code;
    if (running) {
        fail(PSTR("running"));
        return;
    }
    if (rate < LEAST_MILLIHERTZ || rate > MOST_MILLIHERTZ) {
        fail(PSTR("rate must be 1 to 1000 Hz"));
        return;
    }
    if (start < 1 || start > UINT16_MAX) {
        fail(PSTR("seed must be 1 to 65535"));
        return;
    }
    if (text && !strcmp_P(text, PSTR("lfsr")))
        code = LFSR;
    else if (text && !strcmp_P(text, PSTR("irregular")))
        code = IRREGULAR;
    else if (text && !strcmp_P(text, PSTR("regular")))
        code = REGULAR;
    else {
        fail(PSTR("code must be lfsr, irregular or regular"));
        return;
    }
    plan.millihertz = rate;
    plan.period = CYCLES_PER_KILOSECOND / rate;
    plan.rest = CYCLES_PER_KILOSECOND % rate;
    plan.width = plan.period / 2 < LONGEST_PULSE ? plan.period / 2 : LONGEST_PULSE;
    plan.last = strtoul(n, NULL, 10);
    plan.all = rate <= ALL_TO_MILLIHERTZ;
    code_begin(&coder, code, start);
    ATOMIC_BLOCK(ATOMIC_FORCEON)
    {
        listening = 0;
        ticks_in = ticks_out = exposures_in = exposures_out = 0;
        carried = ticks_sent = dropped = exposures_seen = 0;
    }
    armed = 1;
    put_text(PSTR("OK ARM"));
    put_end();
}

static void obey(char *text)
{
    if (!strcmp_P(text, PSTR("ID?"))) {
        put_text(PSTR("ID " NAME));
        put_end();
    } else if (!strncmp_P(text, PSTR("T? "), 3)) {
        uint64_t cycles = now();
        put_text(PSTR("T "));
        put_number(strtoul(text + 3, NULL, 10));
        put_text(PSTR(" "));
        put_us(cycles / CYCLES_PER_US);
        put_end();
    } else if (!strncmp_P(text, PSTR("ARM "), 4)) {
        arm(text + 4);
    } else if (!strcmp_P(text, PSTR("GO"))) {
        if (!armed && !running) {
            fail(PSTR("not armed"));
            return;
        }
        if (armed) /* a host that missed the answer may ask again */
            go();
        armed = 0;
        put_text(PSTR("OK GO "));
        put_us(first_cycles / CYCLES_PER_US);
        put_end();
    } else if (!strcmp_P(text, PSTR("STOP"))) {
        stopping = stop_asked = 1;
        armed = 0;
    } else {
        fail(PSTR("unknown"));
    }
}

/* -- main loop -------------------------------------------------------------------------------- */

/* Send one report, if there is one. */
static uint8_t report(void)
{
    static uint32_t told;
    static uint8_t since;
    uint32_t lost;
    ATOMIC_BLOCK(ATOMIC_FORCEON)
    {
        lost = dropped;
    }
    if (lost != told && ++since >= PATIENCE) {
        since = 0;
        told = lost;
        put_text(PSTR("D "));
        put_number(lost);
    } else if (ticks_in != ticks_out) {
        put_text(PSTR("P "));
        put_number(ticks[ticks_out].number);
        put_text(ticks[ticks_out].bit ? PSTR(" 1 ") : PSTR(" 0 "));
        put_us(ticks[ticks_out].cycles / CYCLES_PER_US);
        ticks_out = (ticks_out + 1) % QUEUE;
    } else if (stop_asked && !running) {
        stop_asked = 0;
        put_text(PSTR("OK STOP "));
        put_number(ticks_sent);
    } else if (exposures_in != exposures_out) {
        put_text(PSTR("X "));
        put_number(exposures[exposures_out].number);
        put_text(PSTR(" "));
        put_us(exposures[exposures_out].cycles / CYCLES_PER_US);
        exposures_out = (exposures_out + 1) % QUEUE;
    } else if (lost != told) {
        since = PATIENCE; /* nothing else to send */
        return 1;
    } else {
        return 0;
    }
    put_end();
    return 1;
}

/* Until any interrupt, unless there is something to do. */
static void rest(void)
{
    cli();
    if (line_waits() || ticks_in != ticks_out || exposures_in != exposures_out
        || (stop_asked && !running)) {
        sei();
        return;
    }
    sleep_enable();
    sei();
    sleep_cpu();
    sleep_disable();
}

int main(void)
{
    MCUSR = 0;
    wdt_disable(); /* a bootloader may have left it on */
    OUTPUT_PORT = EXPOSURE; /* its pull-up: an input that is not wired stays quiet */
    OUTPUT_DIRECTION = TRIGGER | CODE;
    TCCR1B = _BV(ICNC1) | _BV(ICES1) | _BV(CS10);
    TIMSK1 = _BV(TOIE1) | _BV(OCIE1A) | _BV(ICIE1);
    set_sleep_mode(SLEEP_MODE_IDLE);
    line_init();
    sei();
    put_text(PSTR("B " NAME));
    put_end();
    for (;;) {
        char *text = line_read();
        if (text)
            obey(text);
        else if (!report())
            rest();
    }
}

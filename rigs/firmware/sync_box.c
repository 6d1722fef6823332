/* Sync box of SlipLab: what it is told over the serial port, and what it reports.
 *
 * docs/sync-box.md has the protocol; `obey` and `report` follow it line by line. There is no
 * watchdog: old bootloaders of the Nano hang after a watchdog reset. A box that hangs is silent,
 * and the host notices silence.
 */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <stdlib.h>
#include <string.h>

#include "line.h"
#include "train.h"

#define NAME "sliplab-sync-box 2" /* the number is the protocol's */

#define LEAST_MILLIHERTZ 1000UL
#define MOST_MILLIHERTZ 1000000UL
#define MOST_SEED 4294967294UL /* what is too large reads as one more */
#define ALL_TO_MILLIHERTZ 200000UL /* up to here ticks with bit 0 are reported too */
#define PATIENCE 64 /* reports until it is told how many were dropped, while others wait */

/* -- commands --------------------------------------------------------------------------------- */

static uint8_t armed, stop_asked;
static uint64_t first_cycles; /* of tick 0 */

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
    if (train_runs()) {
        fail(PSTR("running"));
        return;
    }
    if (rate < LEAST_MILLIHERTZ || rate > MOST_MILLIHERTZ) {
        fail(PSTR("rate must be 1 to 1000 Hz"));
        return;
    }
    if (start < 1 || start > MOST_SEED) {
        fail(PSTR("seed must be 1 to 4294967294"));
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
    struct train train = {.millihertz = rate, .ticks = strtoul(n, NULL, 10)};
    train.all = rate <= ALL_TO_MILLIHERTZ;
    code_begin(&train.coder, code, start);
    train_arm(&train);
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
        uint64_t cycles = clock_now();
        put_text(PSTR("T "));
        put_number(strtoul(text + 3, NULL, 10));
        put_text(PSTR(" "));
        put_us(cycles / CYCLES_PER_US);
        put_end();
    } else if (!strncmp_P(text, PSTR("ARM "), 4)) {
        arm(text + 4);
    } else if (!strcmp_P(text, PSTR("GO"))) {
        if (!armed && !train_runs()) {
            fail(PSTR("not armed"));
            return;
        }
        if (armed) /* a host that missed the answer may ask again */
            first_cycles = train_go();
        armed = 0;
        put_text(PSTR("OK GO "));
        put_us(first_cycles / CYCLES_PER_US);
        put_end();
    } else if (!strcmp_P(text, PSTR("STOP"))) {
        train_stop();
        stop_asked = 1;
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
    uint32_t lost = train_dropped();
    struct tick tick;
    struct exposure exposure;
    if (lost != told && ++since >= PATIENCE) {
        since = 0;
        told = lost;
        put_text(PSTR("D "));
        put_number(lost);
    } else if (train_tick(&tick)) {
        put_text(PSTR("P "));
        put_number(tick.number);
        put_text(tick.bit ? PSTR(" 1 ") : PSTR(" 0 "));
        put_us(tick.cycles / CYCLES_PER_US);
    } else if (stop_asked && !train_runs()) {
        stop_asked = 0;
        put_text(PSTR("OK STOP "));
        put_number(train_ticks_sent());
    } else if (train_exposure(&exposure)) {
        put_text(PSTR("X "));
        put_number(exposure.number);
        put_text(PSTR(" "));
        put_us(exposure.cycles / CYCLES_PER_US);
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
    if (line_waits() || train_reports_wait() || (stop_asked && !train_runs())) {
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
    train_init();
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

/* Runs the sync box's firmware in simavr with its serial port on a pty, for test_firmware.py.
 *
 * firmware_host ELF TRACE DELAY EVERY WRAPS_AT WRAPS
 *
 * Prints `port` and the name of the pty. The trace gets a line for each change of an output, with
 * the cycle of the timer's match that made it and how many cycles later the simulator showed it (it
 * lets an instruction end first): `1 cycle level late` for the trigger, `2 ...` for the code.
 * `X cycle` is an exposure that was put on the capture pin: DELAY cycles after each trigger, or,
 * where EVERY is not 0, every EVERY cycles. WRAPS is written once to the firmware's count of timer
 * wraps at the address WRAPS_AT, for a box that has been on for long. SIGUSR1 resets the board.
 */
#define _GNU_SOURCE
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_cycle_timers.h>
#include <simavr/sim_elf.h>

#define MHZ 16
#define POLL_CYCLES 1600
#define BOOTED 16000 /* the firmware has cleared its memory, counts and listens */
#define TCNT1L 0x84
#define OCR1AL 0x88
#define LAGS_US 50000 /* behind the wall clock by more than this: do not try to catch up */

static avr_t *avr;
static FILE *trace;
static int port, room = 1;
static avr_cycle_count_t delay, every;
static uint32_t wraps_at, wraps;
static volatile sig_atomic_t reset_asked;

static void ask_reset(int number)
{
    (void)number;
    reset_asked = 1;
}

static uint64_t wall_us(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000ull + t.tv_nsec / 1000;
}

static void set_exposure(int level)
{
    /* the camera is stronger than the pull-up, also when the port is written */
    avr_ioport_external_t camera = {.name = 'B', .mask = 1, .value = level};
    avr_ioctl(avr, AVR_IOCTL_IOPORT_SET_EXTERNAL('B'), &camera);
    avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 0), level);
}

static avr_cycle_count_t end_exposure(avr_t *a, avr_cycle_count_t when, void *param)
{
    (void)a, (void)when, (void)param;
    set_exposure(0);
    return 0;
}

static avr_cycle_count_t expose(avr_t *a, avr_cycle_count_t when, void *param)
{
    (void)param;
    fprintf(trace, "X %llu\n", (unsigned long long)a->cycle);
    set_exposure(1);
    avr_cycle_timer_register(a, 1000, end_exposure, NULL);
    return every ? when + every : 0;
}

static void on_output(struct avr_irq_t *irq, uint32_t value, void *param)
{
    static int levels[2];
    int pin = (int)(intptr_t)param, level = value & 1;
    (void)irq;
    if (level == levels[pin - 1])
        return;
    levels[pin - 1] = level;
    avr_io_addr_t at = AVR_DATA_TO_IO(TCNT1L);
    avr->io[at].r.c(avr, TCNT1L, avr->io[at].r.param); /* lets the counter be worked out */
    uint16_t count = avr->data[TCNT1L] | avr->data[TCNT1L + 1] << 8;
    uint16_t match = avr->data[OCR1AL] | avr->data[OCR1AL + 1] << 8;
    uint16_t late = count - match - 1;
    fprintf(trace, "%d %llu %d %u\n", pin, (unsigned long long)(avr->cycle - late), level, late);
    if (pin == 1 && level && delay)
        avr_cycle_timer_register(avr, delay, expose, NULL);
}

static void on_byte(struct avr_irq_t *irq, uint32_t value, void *param)
{
    uint8_t byte = value;
    (void)irq, (void)param;
    if (write(port, &byte, 1) != 1)
        fprintf(trace, "! nobody reads\n");
}

static void on_room(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    if (value)
        room = param != NULL;
}

/* Bytes from the pty go in, and the simulated time waits for the wall clock. */
static avr_cycle_count_t poll_port(avr_t *a, avr_cycle_count_t when, void *param)
{
    static uint64_t origin;
    static int poked;
    uint8_t bytes[16];
    (void)param;
    ssize_t n = room && a->cycle > BOOTED ? read(port, bytes, sizeof bytes) : 0;
    for (ssize_t i = 0; i < n; i++)
        avr_raise_irq(avr_io_getirq(a, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT), bytes[i]);
    if (!poked && a->cycle > BOOTED) {
        poked = 1;
        for (int i = 0; i < 4 && wraps; i++)
            a->data[wraps_at + i] = wraps >> 8 * i;
    }
    uint64_t wall = wall_us(), simulated = a->cycle / MHZ;
    if (!origin || wall - origin > simulated + LAGS_US)
        origin = wall - simulated;
    if (simulated > wall - origin)
        usleep(simulated - (wall - origin));
    return when + POLL_CYCLES;
}

static void plug_in(void)
{
    room = 1;
    set_exposure(0);
    avr_cycle_timer_register(avr, POLL_CYCLES, poll_port, NULL);
    if (every)
        avr_cycle_timer_register(avr, every, expose, NULL);
}

static void no_sleep(avr_t *a, avr_cycle_count_t cycles)
{
    (void)a, (void)cycles; /* poll_port keeps the pace */
}

int main(int argc, char **argv)
{
    elf_firmware_t firmware = {0};
    if (argc != 7 || elf_read_firmware(argv[1], &firmware))
        return 2;
    trace = fopen(argv[2], "w");
    if (trace)
        setvbuf(trace, NULL, _IOLBF, 0);
    delay = strtoull(argv[3], NULL, 10);
    every = strtoull(argv[4], NULL, 10);
    wraps_at = strtoul(argv[5], NULL, 10);
    wraps = strtoul(argv[6], NULL, 10);

    port = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
    if (!trace || port < 0 || grantpt(port) || unlockpt(port))
        return 2;
    struct termios raw;
    tcgetattr(port, &raw);
    cfmakeraw(&raw);
    tcsetattr(port, TCSANOW, &raw);
    /* held open, so that the port outlives one user and does not echo before the first */
    if (open(ptsname(port), O_RDWR | O_NOCTTY) < 0)
        return 2;

    avr = avr_make_mcu_by_name("atmega328p");
    avr_init(avr);
    avr->frequency = MHZ * 1000000;
    avr->log = LOG_ERROR;
    avr->sleep = no_sleep;
    avr_load_firmware(avr, &firmware);
    uint32_t flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_t *outputs = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 0);
    avr_irq_register_notify(outputs + 1, on_output, (void *)1);
    avr_irq_register_notify(outputs + 2, on_output, (void *)2);
    avr_irq_t *uart = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), 0);
    avr_irq_register_notify(uart + UART_IRQ_OUTPUT, on_byte, NULL);
    avr_irq_register_notify(uart + UART_IRQ_OUT_XON, on_room, (void *)1);
    avr_irq_register_notify(uart + UART_IRQ_OUT_XOFF, on_room, NULL);
    plug_in();
    signal(SIGUSR1, ask_reset);
    printf("port %s\n", ptsname(port)); /* the simulator prints lines of its own */
    fflush(stdout);

    for (int state = cpu_Running; state != cpu_Done && state != cpu_Crashed;) {
        state = avr_run(avr);
        if (reset_asked) {
            reset_asked = 0;
            avr_reset(avr);
            plug_in(); /* the simulator forgot */
        }
    }
    return 1;
}

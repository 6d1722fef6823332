/* Preloaded into a sender: its monotonic clock drifts (FAKE_RATE) and jumps (8 bytes in FAKE_CLOCK). */
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

static volatile long long *jump_ns;
static long long begin_ns;
static double rate;

static long long real_ns(void) {
    struct timespec t;
    syscall(SYS_clock_gettime, CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

int clock_gettime(clockid_t clock, struct timespec *found) {
    if (clock != CLOCK_MONOTONIC) return syscall(SYS_clock_gettime, clock, found);
    if (!jump_ns) {
        int file = open(getenv("FAKE_CLOCK"), O_RDONLY);
        rate = atof(getenv("FAKE_RATE"));
        begin_ns = real_ns();
        jump_ns = mmap(0, 8, PROT_READ, MAP_SHARED, file, 0);
        close(file);
    }
    long long now = real_ns();
    now += (long long)((now - begin_ns) * rate) + *jump_ns;
    found->tv_sec = now / 1000000000LL;
    found->tv_nsec = now % 1000000000LL;
    return 0;
}

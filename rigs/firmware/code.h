/* The codes on the sync line, bit by bit; rigs/core/pulse_code.py defines them. */
#ifndef CODE_H
#define CODE_H

#include <stdint.h>

enum code { LFSR, IRREGULAR, REGULAR };

#define MARKER_TICKS 16 /* of silence behind the first pulse of the regular train */

struct coder {
    enum code code;
    uint32_t state; /* of the register, or of what draws intervals */
    uint8_t silent; /* ticks until the next pulse */
};

static inline void code_begin(struct coder *c, enum code code, uint32_t seed)
{
    c->code = code;
    c->state = seed * 2654435761u;
    c->silent = 0;
}

/* The bit of the next tick. */
static inline uint8_t code_next(struct coder *c)
{
    if (c->code == LFSR) {
        uint32_t s = c->state;
        uint8_t low = s, fed = (low ^ low >> 1 ^ low >> 2 ^ (uint8_t)(s >> 16) >> 6) & 1;
        c->state = s >> 1 | (fed ? 0x80000000u : 0);
        return low & 1;
    }
    if (c->silent) {
        c->silent--;
        return 0;
    }
    if (c->code == IRREGULAR) {
        uint32_t x = c->state;
        x ^= x << 13;
        x ^= x >> 17;
        x ^= x << 5;
        c->state = x;
        c->silent = 1 + (uint8_t)(x >> 29);
    } else {
        c->silent = c->state ? MARKER_TICKS - 1 : 1;
        c->state = 0; /* what marks the first pulse of a regular train: seeds are not 0 */
    }
    return 1;
}

#endif

/* The codes on the sync line, bit by bit; rigs/pulse_code.py defines them. */
#ifndef CODE_H
#define CODE_H

#include <stdint.h>

enum code { LFSR, IRREGULAR, REGULAR };

#define MARKER_TICKS 16 /* of silence behind the first pulse of the regular train */

struct coder {
    enum code code;
    uint16_t lfsr;
    uint32_t xorshift;
    uint8_t silent; /* ticks until the next pulse */
};

static inline void code_begin(struct coder *c, enum code code, uint16_t seed)
{
    c->code = code;
    c->lfsr = seed;
    c->xorshift = seed * 2654435761u;
    c->silent = 0;
}

/* The bit of the next tick. */
static inline uint8_t code_next(struct coder *c)
{
    if (c->code == LFSR) {
        uint16_t s = c->lfsr;
        uint16_t fed = (s ^ s >> 2 ^ s >> 3 ^ s >> 5) & 1;
        c->lfsr = s >> 1 | fed << 15;
        return s & 1;
    }
    if (c->silent) {
        c->silent--;
        return 0;
    }
    if (c->code == IRREGULAR) {
        uint32_t x = c->xorshift;
        x ^= x << 13;
        x ^= x >> 17;
        x ^= x << 5;
        c->xorshift = x;
        c->silent = 1 + (uint8_t)(x >> 29);
    } else {
        c->silent = c->xorshift ? MARKER_TICKS - 1 : 1;
        c->xorshift = 0; /* what marks the first pulse of a regular train: seeds are not 0 */
    }
    return 1;
}

#endif

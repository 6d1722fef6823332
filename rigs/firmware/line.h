/* Lines over the serial port: `body*CC\n`, CC the low byte of the body's CRC-32 in hex. */
#ifndef LINE_H
#define LINE_H

#include <stdint.h>

#define BAUD 500000UL /* divides 16 MHz: no error, and 50 bytes a millisecond */

void line_init(void);

/* The body of the next line that came whole and right; NULL if there is none. A line that is wrong
 * is answered with an error here. Good until the next call. */
char *line_read(void);

/* Whether bytes wait that `line_read` has not seen. */
uint8_t line_waits(void);

/* Parts of a line to send, then its end. They wait for room in the buffer, which the port empties
 * by itself at its own pace. */
void put_text(const char *text); /* in program memory: PSTR("...") */
void put_number(uint32_t value);
void put_us(uint64_t us);
void put_end(void);

#endif

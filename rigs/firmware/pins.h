/* Where the sync box is wired: the only place that names pins.
 *
 * ATmega328P with a 16 MHz crystal (Arduino Nano or Uno, 5 V levels).
 *
 *   D9   PB1  OC1A  out  trigger: rises on every tick -> trigger input of the frame camera
 *   D10  PB2  OC1B  out  code: rises on ticks with a code bit 1 -> trigger input of the event
 *                        camera, digital input of the arm
 *   D8   PB0  ICP1  in   exposure: the frame camera's ExposureActive output, rising at the start
 *   D0/D1           USB serial, 500,000 baud, 8N1
 *
 * The two outputs have to be the compare outputs of Timer1 and the input its capture pin: the
 * timer itself makes and stamps the edges, so no interrupt's latency is in them. Both outputs rise
 * on the same cycle. Optocouplers and levels: docs/sync-box.md.
 */
#ifndef PINS_H
#define PINS_H

#include <avr/io.h>

#define OUTPUT_PORT PORTB
#define OUTPUT_DIRECTION DDRB
#define TRIGGER _BV(PB1)
#define CODE _BV(PB2)
#define EXPOSURE _BV(PB0)

#endif

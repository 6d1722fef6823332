#include "line.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <stddef.h>

#define LONGEST 48
#define RECEIVED 64 /* powers of two: their indices wrap by themselves */
#define SENT 128

static volatile uint8_t received[RECEIVED], received_in, received_out;
static volatile uint8_t sent[SENT], sent_in, sent_out;

static const uint32_t crc_table[16] PROGMEM = {
    0x00000000, 0x1db71064, 0x3b6e20c8, 0x26d930ac, 0x76dc4190, 0x6b6b51f4, 0x4db26158, 0x5005713c,
    0xedb88320, 0xf00f9344, 0xd6d6a3e8, 0xcb61b38c, 0x9b64c2b0, 0x86d3d2d4, 0xa00ae278, 0xbdbdf21c,
};
static const char hex[] PROGMEM = "0123456789ABCDEF";

static uint32_t crc_of_line = UINT32_MAX;

static uint32_t crc_add(uint32_t crc, uint8_t byte)
{
    crc ^= byte;
    crc = crc >> 4 ^ pgm_read_dword(&crc_table[crc & 15]);
    return crc >> 4 ^ pgm_read_dword(&crc_table[crc & 15]);
}

void line_init(void)
{
    UCSR0A = _BV(U2X0);
    UBRR0 = F_CPU / 8 / BAUD - 1;
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0);
}

ISR(USART_RX_vect)
{
    uint8_t byte = UDR0, next = (received_in + 1) % RECEIVED;
    if (next != received_out) { /* a byte without room is lost: the checksum tells */
        received[received_in] = byte;
        received_in = next;
    }
}

ISR(USART_UDRE_vect)
{
    if (sent_in == sent_out) {
        UCSR0B &= ~_BV(UDRIE0);
    } else {
        UDR0 = sent[sent_out];
        sent_out = (sent_out + 1) % SENT;
    }
}

static void put_raw(uint8_t byte)
{
    uint8_t next = (sent_in + 1) % SENT;
    while (next == sent_out)
        ;
    sent[sent_in] = byte;
    sent_in = next;
    UCSR0B |= _BV(UDRIE0); /* the interrupt only ever clears it, and then there is no byte */
}

static void put(uint8_t byte)
{
    crc_of_line = crc_add(crc_of_line, byte);
    put_raw(byte);
}

void put_text(const char *text)
{
    uint8_t byte;
    while ((byte = pgm_read_byte(text++)))
        put(byte);
}

/* By subtraction: the processor has no division, and one in software takes far longer. */
static void put_digits(uint32_t value, uint8_t least)
{
    static const uint32_t powers[10] PROGMEM = {
        1000000000, 100000000, 10000000, 1000000, 100000, 10000, 1000, 100, 10, 1,
    };
    for (uint8_t place = 10; place; place--) {
        uint32_t power = pgm_read_dword(&powers[10 - place]);
        uint8_t digit = '0';
        for (; value >= power; value -= power)
            digit++;
        if (digit != '0' || place <= least) {
            put(digit);
            least = place;
        }
    }
}

void put_number(uint32_t value)
{
    put_digits(value, 1);
}

void put_us(uint64_t us)
{
    /* Times come nearly in order, so the leading digits are stepped: a division of 64 bits would
     * take as long as the rest of the line. */
    static uint64_t begin;
    static uint32_t thousand_seconds;
    for (; us < begin; begin -= 1000000000)
        thousand_seconds--;
    for (; us - begin >= 1000000000; begin += 1000000000)
        thousand_seconds++;
    if (thousand_seconds)
        put_digits(thousand_seconds, 1);
    put_digits(us - begin, thousand_seconds ? 9 : 1);
}

void put_end(void)
{
    uint8_t check = ~crc_of_line;
    crc_of_line = UINT32_MAX;
    put_raw('*');
    put_raw(pgm_read_byte(&hex[check >> 4]));
    put_raw(pgm_read_byte(&hex[check & 15]));
    put_raw('\n');
}

uint8_t line_waits(void)
{
    return received_in != received_out;
}

/* The body of a line of `length` bytes, ended where its checksum begins; NULL if that is wrong. */
static char *checked(char *line, uint8_t length)
{
    uint32_t crc = UINT32_MAX;
    if (length < 4 || line[length - 3] != '*')
        return NULL;
    for (uint8_t i = 0; i < length - 3; i++)
        crc = crc_add(crc, line[i]);
    uint8_t check = ~crc;
    if ((uint8_t)line[length - 2] != pgm_read_byte(&hex[check >> 4])
        || (uint8_t)line[length - 1] != pgm_read_byte(&hex[check & 15]))
        return NULL;
    line[length - 3] = 0;
    return line;
}

char *line_read(void)
{
    static char line[LONGEST];
    static uint8_t length;
    while (line_waits()) {
        char byte = received[received_out];
        received_out = (received_out + 1) % RECEIVED;
        if (byte != '\n') {
            if (length < LONGEST)
                line[length] = byte;
            length += length <= LONGEST; /* one past the buffer says that the line is too long */
            continue;
        }
        char *body = length <= LONGEST ? checked(line, length) : NULL;
        length = 0;
        if (body)
            return body;
        put_text(PSTR("E checksum"));
        put_end();
    }
    return NULL;
}

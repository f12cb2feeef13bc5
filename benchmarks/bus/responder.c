/* The two ends of a pty for benchmarks/bus_cycle.py.
 *
 * responder serve FD BYTE_NS        servos: answers Sync Read (82) and Fast Sync Read (8A) on the pty's master side, at
 *                                   once, or after the time that request and reply take on a wire of BYTE_NS per byte.
 *                                   If ten bytes are requested, an arm at rest answers: Present Current (the servo's
 *                                   goal in the last Sync Write of Goal Current), velocity 0, and a position of half a
 *                                   turn, one tick more in every other answer. Other registers return a counter.
 * responder client TTY SERVOS CYCLES WRITES
 *                                   the cheapest possible client in C: the same packets, prepared, in WRITES writes,
 *                                   and one blocking read. Prints nanoseconds: CPU per cycle, median round trip, time
 *                                   per cycle.
 */
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

static uint16_t table[256];

static void make_table(void) {
    for (int i = 0; i < 256; i++) {
        uint16_t value = (uint16_t)(i << 8);
        for (int bit = 0; bit < 8; bit++) value = (uint16_t)(value & 0x8000 ? value << 1 ^ 0x8005 : value << 1);
        table[i] = value;
    }
}

static uint16_t crc(const uint8_t *data, int count) {
    uint16_t value = 0;
    for (int i = 0; i < count; i++) value = (uint16_t)(value << 8 ^ table[(value >> 8 ^ data[i]) & 0xFF]);
    return value;
}

static int end_packet(uint8_t *packet, int count) {
    uint16_t check = crc(packet, count);
    packet[count] = (uint8_t)check;
    packet[count + 1] = (uint8_t)(check >> 8);
    return count + 2;
}

static int64_t now_ns(clockid_t clock) {
    struct timespec t;
    clock_gettime(clock, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static void sleep_until(int64_t ns) {
    struct timespec t = {ns / 1000000000LL, ns % 1000000000LL};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL);
}

static int head(uint8_t *packet, int id, int length) {
    const uint8_t start[8] = {0xFF, 0xFF, 0xFD, 0x00, (uint8_t)id, (uint8_t)length, (uint8_t)(length >> 8), 0x55};
    memcpy(packet, start, 8);
    return 8;
}

static uint8_t goals[256][2];

/* A Sync Write of two-byte goals: the motors carry the commanded currents. */
static void listen(const uint8_t *request, int end) {
    if (request[7] != 0x83 || request[10] != 2) return;
    for (int at = 12; at + 3 <= end - 2; at += 3) memcpy(goals[request[at]], request + at + 1, 2);
}

static void fill(uint8_t *data, int size, int id, uint8_t count) {
    const uint8_t rest[10] = {goals[id][0], goals[id][1], 0, 0, 0, 0, (uint8_t)(count & 1), 8, 0, 0};
    if (size == 10) memcpy(data, rest, 10);
    else memset(data, count, (size_t)size);
}

static int answer(const uint8_t *request, int end, uint8_t *reply) {
    static uint8_t count;
    int size = request[10] | request[11] << 8, servos = end - 14, at = 0;
    count = (count + 1) & 0x7F; /* never FF, so that nothing is stuffed */
    if (request[7] == 0x8A) at = head(reply, 0xFE, 1 + servos * (size + 4));
    for (int servo = 0; servo < servos; servo++) {
        if (request[7] == 0x8A) {
            reply[at++] = 0;
            reply[at++] = request[12 + servo];
            fill(reply + at, size, request[12 + servo], count);
            at = end_packet(reply, at + size);
        } else {
            int start = at;
            at += head(reply + at, request[12 + servo], size + 4);
            reply[at++] = 0;
            fill(reply + at, size, request[12 + servo], count);
            at = start + end_packet(reply + start, at + size - start);
        }
    }
    return at;
}

static int serve(int fd, int64_t byte_ns) {
    uint8_t buffer[4096], reply[4096];
    int have = 0;
    int64_t sent = 0;
    prctl(PR_SET_TIMERSLACK, 1);
    for (;;) {
        ssize_t got = read(fd, buffer + have, sizeof buffer - (size_t)have);
        if (got <= 0) return 0;
        int64_t now = now_ns(CLOCK_MONOTONIC);
        sent = (sent > now ? sent : now) + got * byte_ns;
        have += (int)got;
        while (have >= 7) {
            int end = 7 + (buffer[5] | buffer[6] << 8);
            if (have < end) break;
            listen(buffer, end);
            if (buffer[7] == 0x82 || buffer[7] == 0x8A) {
                int count = answer(buffer, end, reply);
                sent += count * byte_ns;
                if (byte_ns) sleep_until(sent);
                if (write(fd, reply, (size_t)count) != count) return 1;
            }
            have -= end;
            memmove(buffer, buffer + end, (size_t)have);
        }
    }
}

static int compare(const void *a, const void *b) {
    int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
    return (x > y) - (x < y);
}

static int client(const char *tty, int servos, int cycles, int writes) {
    int fd = open(tty, O_RDWR | O_NOCTTY);
    struct termios settings;
    uint8_t request[1024], reply[1024];
    if (fd < 0 || tcgetattr(fd, &settings)) return 1;
    cfmakeraw(&settings);
    settings.c_cc[VMIN] = 1;
    settings.c_cc[VTIME] = 0;
    tcsetattr(fd, TCSANOW, &settings);
    int length = 7 + 3 * servos, expected = 21 * servos;
    const uint8_t front[12] = {0xFF, 0xFF, 0xFD, 0, 0xFE, (uint8_t)length, (uint8_t)(length >> 8), 0x83, 102, 0, 2, 0};
    const uint8_t read_front[12] = {0xFF, 0xFF, 0xFD, 0, 0xFE, (uint8_t)(7 + servos), 0, 0x82, 126, 0, 10, 0};
    int64_t *trip = calloc((size_t)cycles, sizeof *trip);
    int64_t cpu = now_ns(CLOCK_PROCESS_CPUTIME_ID), start = now_ns(CLOCK_MONOTONIC);
    for (int cycle = 0; cycle < cycles; cycle++) {
        int at = 12;
        memcpy(request, front, 12);
        for (int servo = 0; servo < servos; servo++) {
            request[at++] = (uint8_t)(servo + 1);
            request[at++] = (uint8_t)(cycle & 0x7F);
            request[at++] = 0;
        }
        int split = end_packet(request, at), count = split;
        memcpy(request + count, read_front, 12);
        for (int servo = 0; servo < servos; servo++) request[count + 12 + servo] = (uint8_t)(servo + 1);
        count += end_packet(request + count, 12 + servos);
        int64_t before = now_ns(CLOCK_MONOTONIC);
        if (writes == 1) {
            if (write(fd, request, (size_t)count) != count) return 1;
        } else if (write(fd, request, (size_t)split) != split ||
                   write(fd, request + split, (size_t)(count - split)) != count - split) {
            return 1;
        }
        for (int have = 0; have < expected;) {
            ssize_t got = read(fd, reply + have, (size_t)(expected - have));
            if (got <= 0) return 1;
            have += (int)got;
        }
        for (int servo = 0; servo < servos; servo++) {
            uint8_t *packet = reply + 21 * servo;
            if (crc(packet, 19) != (packet[19] | packet[20] << 8)) return 2;
        }
        trip[cycle] = now_ns(CLOCK_MONOTONIC) - before;
    }
    cpu = now_ns(CLOCK_PROCESS_CPUTIME_ID) - cpu;
    int64_t whole = now_ns(CLOCK_MONOTONIC) - start;
    qsort(trip, (size_t)cycles, sizeof *trip, compare);
    printf("%lld %lld %lld\n", (long long)(cpu / cycles), (long long)trip[cycles / 2], (long long)(whole / cycles));
    return 0;
}

int main(int count, char **words) {
    make_table();
    if (count == 4 && !strcmp(words[1], "serve")) return serve(atoi(words[2]), atoll(words[3]));
    if (count == 6 && !strcmp(words[1], "client"))
        return client(words[2], atoi(words[3]), atoi(words[4]), atoi(words[5]));
    fprintf(stderr, "usage: responder serve FD BYTE_NS | responder client TTY SERVOS CYCLES WRITES\n");
    return 2;
}

/* Virtual time for Betaflight's simulator target (SITL), as a library that is loaded before its own (LD_PRELOAD).
 *
 * SPDX-License-Identifier: Apache-2.0 OR GPL-3.0-or-later
 * It runs inside a process under the GPL, whose source it neither contains nor links to: hence the second licence.
 *
 * The firmware runs as it is, with three changes around it:
 * - Time passes only where the main loop sleeps or reads the clock, so it does not depend on the host.
 * - Its threads run as coroutines of the main loop while that sleeps, so their order is fixed.
 * - Its four UDP sockets are one inherited socket: at each step of virtual time it sends the motor outputs and waits for
 *   the state and, optionally, the sticks. Its command line is an inherited listening socket, or nothing.
 *
 * Environment: VIRTUAL_TIME_STEP_NS; VIRTUAL_TIME_EXCHANGE and VIRTUAL_TIME_COMMANDS, descriptors of the two sockets.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <netinet/in.h>
#include <pthread.h>
#include <signal.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <time.h>
#include <ucontext.h>
#include <unistd.h>

enum { CLOCK_READ_NS = 1000, STACK = 1 << 18, COROUTINES = 8 };
enum { PORT_COMMANDS = 5761, PORT_MOTORS = 9002, PORT_STATE = 9003, PORT_STICKS = 9004 };

/* Packets of the simulator target, as it expects them on its ports. */
struct request {
    double state[18];                                  /* time, gyro, acceleration, quaternion, velocity, position, pressure */
    struct { double time; uint16_t channels[16]; } sticks; /* only if the request is of full length */
};

struct coroutine {
    ucontext_t context;
    int descriptor; /* what it waits for in select; the command line waits for several: -1 */
};

static struct coroutine coroutines[COROUTINES];
static struct coroutine *running; /* NULL: the main loop */
static ucontext_t main_loop;
static int count, exchange = -1, commands = -1, state_socket = -1, sticks_socket = -1;
static int64_t step_ns, now_ns = 1000000000, next_ns, seen_ns; /* seen_ns: time that coroutines see, exactly that of the step */
static struct request request;
static float motors[4];

__attribute__((constructor)) static void start(void)
{
    const char *given = getenv("VIRTUAL_TIME_COMMANDS");
    prctl(PR_SET_PDEATHSIG, SIGKILL); /* also where the firmware loops after an error of its own */
    commands = given ? atoi(given) : -1;
    exchange = atoi(getenv("VIRTUAL_TIME_EXCHANGE"));
    step_ns = atoll(getenv("VIRTUAL_TIME_STEP_NS"));
    next_ns = now_ns + step_ns;
}

static void resume(struct coroutine *one)
{
    running = one;
    swapcontext(&main_loop, &one->context);
    running = NULL;
}

/* Send the motor outputs, wait for the state of the next step, and let the coroutines receive it. */
static void step(void)
{
    if (send(exchange, motors, sizeof motors, MSG_NOSIGNAL) != sizeof motors)
        _exit(0); /* the simulation has ended */
    ssize_t length = recv(exchange, &request, sizeof request, 0);
    if (length <= 0)
        _exit(0);
    for (int i = 0; i < count; i++) {
        int waits_for = coroutines[i].descriptor;
        if (waits_for == state_socket || (waits_for == sticks_socket && length == sizeof request) ||
            (waits_for == -1 && commands >= 0))
            resume(&coroutines[i]);
    }
}

/* Let time pass; steps take place only where the main loop sleeps, as it holds no lock there. */
int nanosleep(const struct timespec *time, struct timespec *rest)
{
    (void)rest;
    if (running)
        return 0;
    int64_t until_ns = now_ns + time->tv_sec * INT64_C(1000000000) + time->tv_nsec;
    while (next_ns <= until_ns) {
        seen_ns = next_ns;
        next_ns += step_ns;
        if (state_socket >= 0 && sticks_socket >= 0)
            step();
    }
    now_ns = until_ns;
    return 0;
}

int clock_gettime(clockid_t clock, struct timespec *time)
{
    (void)clock;
    if (!running)
        now_ns += CLOCK_READ_NS; /* the main loop polls the clock */
    int64_t ns = running ? seen_ns : now_ns;
    time->tv_sec = ns / 1000000000;
    time->tv_nsec = ns % 1000000000;
    return 0;
}

int pthread_create(pthread_t *thread, const pthread_attr_t *attributes, void *(*function)(void *), void *argument)
{
    (void)attributes;
    if (count == COROUTINES)
        return EAGAIN;
    struct coroutine *one = &coroutines[count++];
    getcontext(&one->context);
    one->context.uc_stack.ss_sp = malloc(STACK);
    one->context.uc_stack.ss_size = STACK;
    one->context.uc_link = &main_loop;
    makecontext(&one->context, (void (*)(void))function, 1, argument);
    *thread = (pthread_t)count;
    resume(one); /* until it waits */
    return 0;
}

int pthread_join(pthread_t thread, void **result)
{
    (void)thread, (void)result;
    return 0;
}

/* A coroutine waits for the next step here; the command line then receives what is there. */
int select(int descriptors, fd_set *to_read, fd_set *to_write, fd_set *exceptions, struct timeval *timeout)
{
    struct timespec none = {0, 0};
    (void)timeout;
    if (running) {
        int last = descriptors - 1;
        running->descriptor = last == state_socket || last == sticks_socket ? last : -1;
        struct coroutine *one = running;
        swapcontext(&one->context, &main_loop);
        if (one->descriptor != -1)
            return 1;
    }
    return pselect(descriptors, to_read, to_write, exceptions, &none, NULL);
}

int bind(int descriptor, const struct sockaddr *address, socklen_t length)
{
    int type = 0, port = ntohs(((const struct sockaddr_in *)address)->sin_port); /* at the same place in IPv6 */
    socklen_t size = sizeof type;
    (void)length;
    getsockopt(descriptor, SOL_SOCKET, SO_TYPE, &type, &size);
    if (type == SOCK_DGRAM) {
        *(port == PORT_STATE ? &state_socket : &sticks_socket) = descriptor;
        return 0;
    }
    if (port == PORT_COMMANDS && commands >= 0)
        return dup2(commands, descriptor) < 0 ? -1 : 0;
    errno = EADDRINUSE;
    return -1;
}

ssize_t recvfrom(int descriptor, void *data, size_t size, int flags, struct sockaddr *from, socklen_t *length)
{
    (void)flags, (void)from, (void)length;
    int is_state = descriptor == state_socket;
    size_t given = is_state ? sizeof request.state : sizeof request.sticks;
    memcpy(data, is_state ? (void *)request.state : (void *)&request.sticks, given < size ? given : size);
    return (ssize_t)given;
}

ssize_t sendto(int descriptor, const void *data, size_t size, int flags, const struct sockaddr *to, socklen_t length)
{
    (void)descriptor, (void)flags, (void)length;
    if (ntohs(((const struct sockaddr_in *)to)->sin_port) == PORT_MOTORS && size == sizeof motors)
        memcpy(motors, data, size);
    return (ssize_t)size;
}

/* Steps the clock of the processes that load this (LD_PRELOAD): CLOCK_AHEAD names a file with the
   seconds that their clock is ahead, as a number of 8 bytes. Waits until some time end in time. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static const volatile int64_t *ahead;

__attribute__((constructor)) static void open_file(void)
{
    const char *name = getenv("CLOCK_AHEAD");
    int file = name ? open(name, O_RDONLY | O_CLOEXEC) : -1;
    if (file >= 0) {
        void *page = mmap(NULL, sizeof *ahead, PROT_READ, MAP_SHARED, file, 0);
        ahead = page == MAP_FAILED ? NULL : page;
        close(file);
    }
}

static int64_t ahead_s(void)
{
    return ahead ? *ahead : 0;
}

/* Times of the monotonic clock count from the start of the machine: they are small. */
static struct timespec as_kernel_counts(const struct timespec *until)
{
    struct timespec shifted = *until;
    if (shifted.tv_sec > 1000000000)
        shifted.tv_sec -= ahead_s();
    return shifted;
}

int clock_gettime(clockid_t clock, struct timespec *now)
{
    static int (*original)(clockid_t, struct timespec *);
    if (!original)
        original = dlsym(RTLD_NEXT, "clock_gettime");
    int result = original(clock, now);
    if (result == 0 && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE))
        now->tv_sec += ahead_s();
    return result;
}

int gettimeofday(struct timeval *now, void *zone)
{
    struct timespec time;
    (void)zone;
    clock_gettime(CLOCK_REALTIME, &time);
    now->tv_sec = time.tv_sec;
    now->tv_usec = time.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *result)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (result)
        *result = now.tv_sec;
    return now.tv_sec;
}

int pthread_cond_timedwait(pthread_cond_t *condition, pthread_mutex_t *mutex,
                           const struct timespec *until)
{
    static int (*original)(pthread_cond_t *, pthread_mutex_t *, const struct timespec *);
    if (!original) /* the newer of two versions */
        original = dlvsym(RTLD_NEXT, "pthread_cond_timedwait", "GLIBC_2.3.2");
    struct timespec shifted = as_kernel_counts(until);
    return original(condition, mutex, &shifted);
}

int sem_timedwait(sem_t *semaphore, const struct timespec *until)
{
    static int (*original)(sem_t *, const struct timespec *);
    if (!original)
        original = dlsym(RTLD_NEXT, "sem_timedwait");
    struct timespec shifted = as_kernel_counts(until);
    return original(semaphore, &shifted);
}

/* Faults at the calls that change the disk: preloaded (LD_PRELOAD), switched on by fault_set.
 *
 * Counts calls that write to, create, rename or remove files under a folder; writes that follow one another into one
 * file count once, for encoders write byte by byte. At the given call, and at those that write or create from there on,
 * it fails as on a full disk, or it kills the process. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/uio.h>
#include <unistd.h>

static char under[4096];
static long at, calls;
static int kills;

void fault_set(const char *folder, long number, int kill_it) {
    strncpy(under, folder, sizeof under - 1);
    at = number;
    kills = kill_it;
    calls = 0;
}

long fault_calls(void) { return calls; }

static int inside(const char *path) { return under[0] && strncmp(path, under, strlen(under)) == 0; }


/* Does this call fail? */
static int counted(int watched, int takes_room) {
    if (!watched) return 0;
    long number = __atomic_add_fetch(&calls, 1, __ATOMIC_SEQ_CST);
    if (!at || number < at) return 0;
    if (kills) raise(SIGKILL);
    if (!takes_room) return 0;
    errno = ENOSPC;
    return 1;
}

/* Does a write to this file fail? */
static int written(int fd) {
    static char last[4096];
    static int failed;
    char link[64], path[4096];
    if (!under[0]) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, sizeof path - 1);
    if (n < 0) return 0;
    path[n] = 0;
    if (!inside(path)) return 0;
    if (strcmp(path, last)) failed = counted(1, 1);
    strcpy(last, path);
    if (failed) errno = ENOSPC;
    return failed;
}

#define REAL(type, name, ...) \
    static type (*real)(__VA_ARGS__); \
    if (!real) real = (type (*)(__VA_ARGS__))dlsym(RTLD_NEXT, name)

ssize_t write(int fd, const void *data, size_t size) {
    REAL(ssize_t, "write", int, const void *, size_t);
    return written(fd) ? -1 : real(fd, data, size);
}

ssize_t writev(int fd, const struct iovec *data, int count) {
    REAL(ssize_t, "writev", int, const struct iovec *, int);
    return written(fd) ? -1 : real(fd, data, count);
}

ssize_t pwrite(int fd, const void *data, size_t size, off_t offset) {
    REAL(ssize_t, "pwrite", int, const void *, size_t, off_t);
    return written(fd) ? -1 : real(fd, data, size, offset);
}

ssize_t pwrite64(int fd, const void *data, size_t size, off64_t offset) {
    REAL(ssize_t, "pwrite64", int, const void *, size_t, off64_t);
    return written(fd) ? -1 : real(fd, data, size, offset);
}

size_t fwrite(const void *data, size_t size, size_t count, FILE *file) {
    REAL(size_t, "fwrite", const void *, size_t, size_t, FILE *);
    return written(fileno(file)) ? 0 : real(data, size, count, file);
}

static int creates(const char *path, int flags) { return (flags & O_CREAT) && inside(path); }

#define OPEN(function) \
    int function(const char *path, int flags, ...) { \
        va_list more; \
        va_start(more, flags); \
        mode_t mode = va_arg(more, mode_t); \
        va_end(more); \
        REAL(int, #function, const char *, int, ...); \
        return counted(creates(path, flags), 1) ? -1 : real(path, flags, mode); \
    }
OPEN(open)
OPEN(open64)

int rename(const char *old, const char *new) {
    REAL(int, "rename", const char *, const char *);
    return counted(inside(new), 0) ? -1 : real(old, new);
}

int unlink(const char *path) {
    REAL(int, "unlink", const char *);
    return counted(inside(path), 0) ? -1 : real(path);
}

int mkdir(const char *path, mode_t mode) {
    REAL(int, "mkdir", const char *, mode_t);
    return counted(inside(path), 1) ? -1 : real(path, mode);
}

/* A disk that does not give one file: preloaded, it fails the calls of EIO_CALLS for the path EIO_PATH. */
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

static int fails(const char *call, const char *path) {
    const char *calls = getenv("EIO_CALLS"), *meant = getenv("EIO_PATH");
    if (!calls || !meant || !strstr(calls, call) || strcmp(path, meant)) return 0;
    errno = EIO;
    return 1;
}

static int fails_open(const char *call, int descriptor) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", descriptor);
    ssize_t size = readlink(link, path, sizeof path - 1);
    if (size <= 0) return 0;
    path[size] = 0;
    return fails(call, path);
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define OPENS(name)                                              \
    int name(const char *path, int flags, ...) {                 \
        va_list rest;                                            \
        va_start(rest, flags);                                   \
        mode_t mode = va_arg(rest, int);                         \
        va_end(rest);                                            \
        return fails("open", path) ? -1 : REAL(name)(path, flags, mode); \
    }
#define STATS(name, type) \
    int name(const char *path, type *to) { return fails("stat", path) ? -1 : REAL(name)(path, to); }

OPENS(open)
OPENS(open64)
STATS(stat, struct stat)
STATS(stat64, struct stat64)
STATS(lstat, struct stat)
STATS(lstat64, struct stat64)
ssize_t read(int from, void *to, size_t size) { return fails_open("read", from) ? -1 : REAL(read)(from, to, size); }
DIR *opendir(const char *path) { return fails("list", path) ? NULL : REAL(opendir)(path); }

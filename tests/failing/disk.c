/* A disk that misbehaves, for all operations of rosrescue on files whose path contains DISK_PATH. The first letter in
 * the file DISK_STATE says how; without that file all operations work.
 *   h  every operation hangs until the letter changes
 *   o  opening a file hangs
 *   y  syncing a file hangs
 *   n  syncing a new checkpoint hangs, before it has its name
 *   s  each operation takes 0.2 s
 *   f  the disk is full: writes are done in part or not at all
 *   r  the disk is read-only */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

enum kind { LOOKS, OPENS, CREATES, SYNCS, GROWS, CHANGES };

static int is_rosrescue;

__attribute__((constructor)) static void look_at_the_process(void)
{
    char program[4096];
    ssize_t length = readlink("/proc/self/exe", program, sizeof program - 1);
    program[length < 0 ? 0 : length] = 0;
    is_rosrescue = strstr(program, "/rosrescue") != NULL;
}

static char state(void)
{
    char letter = 0;
    const char *path = is_rosrescue ? getenv("DISK_STATE") : NULL;
    int file = path == NULL ? -1 : (int)syscall(SYS_openat, AT_FDCWD, path, O_RDONLY | O_CLOEXEC, 0);
    if (file < 0)
        return 0;
    if (syscall(SYS_read, file, &letter, 1) != 1)
        letter = 0;
    syscall(SYS_close, file);
    return letter;
}

/* The error with which an operation of this kind fails, or zero. */
static int meets(const char *path, enum kind kind)
{
    const char *part = getenv("DISK_PATH");
    if (part == NULL || path == NULL || strstr(path, part) == NULL)
        return 0;
    char now = state();
    while (now == 'h' || (now == 'o' && (kind == OPENS || kind == CREATES)) || (now == 'y' && kind == SYNCS)
           || (now == 'n' && kind == SYNCS && strstr(path, ".new-") != NULL)) {
        usleep(1000);
        now = state();
    }
    if (now == 's')
        usleep(200000);
    if (now == 'f' && kind == GROWS)
        return ENOSPC;
    if (now == 'r' && (kind == GROWS || kind == CHANGES || kind == CREATES))
        return EROFS;
    return 0;
}

static int meets_file(int file, enum kind kind)
{
    if (state() == 0)
        return 0;
    char link[40], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, path, sizeof path - 1);
    path[length < 0 ? 0 : length] = 0;
    return meets(path, kind);
}

#define FAIL_IF(why)                                                                                                   \
    do {                                                                                                               \
        int found = (why);                                                                                             \
        if (found != 0) {                                                                                              \
            errno = found;                                                                                             \
            return -1;                                                                                                 \
        }                                                                                                              \
    } while (0)

ssize_t write(int file, const void *bytes, size_t count)
{
    int why = meets_file(file, GROWS);
    if (why == ENOSPC && count > 40)
        return syscall(SYS_write, file, bytes, 20);
    FAIL_IF(why);
    return syscall(SYS_write, file, bytes, count);
}

int fsync(int file)
{
    FAIL_IF(meets_file(file, SYNCS));
    return syscall(SYS_fsync, file);
}

int fdatasync(int file)
{
    FAIL_IF(meets_file(file, SYNCS));
    return syscall(SYS_fdatasync, file);
}

int statx(int folder, const char *restrict path, int flags, unsigned mask, struct statx *restrict found)
{
    FAIL_IF(*path == 0 ? meets_file(folder, LOOKS) : meets(path, LOOKS));
    return syscall(SYS_statx, folder, path, flags, mask, found);
}

int rename(const char *from, const char *to)
{
    FAIL_IF(meets(from, CHANGES));
    return syscall(SYS_renameat2, AT_FDCWD, from, AT_FDCWD, to, 0);
}

int unlink(const char *path)
{
    FAIL_IF(meets(path, CHANGES));
    return syscall(SYS_unlinkat, AT_FDCWD, path, 0);
}

int link(const char *from, const char *to)
{
    FAIL_IF(meets(to, CHANGES));
    return syscall(SYS_linkat, AT_FDCWD, from, AT_FDCWD, to, 0);
}

int linkat(int from_folder, const char *from, int to_folder, const char *to, int flags)
{
    FAIL_IF(meets(to, CHANGES));
    return syscall(SYS_linkat, from_folder, from, to_folder, to, flags);
}

char *realpath(const char *path, char *real)
{
    static char *(*next)(const char *, char *);
    if (meets(path, LOOKS) != 0)
        return NULL;
    if (next == NULL)
        next = (char *(*)(const char *, char *))dlsym(RTLD_NEXT, "realpath");
    return next(path, real);
}

static int open_file(int folder, const char *path, int flags, mode_t mode)
{
    FAIL_IF(meets(path, (flags & O_ACCMODE) == O_RDONLY ? OPENS : CREATES));
    return syscall(SYS_openat, folder, path, flags, mode);
}

#define MODE(flags)                                                                                                    \
    mode_t mode = 0;                                                                                                   \
    if ((flags) & (O_CREAT | O_TMPFILE)) {                                                                             \
        va_list rest;                                                                                                  \
        va_start(rest, flags);                                                                                         \
        mode = va_arg(rest, mode_t);                                                                                   \
        va_end(rest);                                                                                                  \
    }

int open(const char *path, int flags, ...)
{
    MODE(flags)
    return open_file(AT_FDCWD, path, flags, mode);
}

int open64(const char *path, int flags, ...)
{
    MODE(flags)
    return open_file(AT_FDCWD, path, flags | O_LARGEFILE, mode);
}

int openat(int folder, const char *path, int flags, ...)
{
    MODE(flags)
    return open_file(folder, path, flags, mode);
}

int openat64(int folder, const char *path, int flags, ...)
{
    MODE(flags)
    return open_file(folder, path, flags | O_LARGEFILE, mode);
}

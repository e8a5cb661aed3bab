/* A disk that takes its time: what is to be forced to it waits for as long as the file HELD_SYNC is there. */
#define _GNU_SOURCE
#include <stdlib.h>
#include <sys/syscall.h>
#include <unistd.h>

static void wait_for_the_disk(void)
{
    const char *held = getenv("HELD_SYNC");
    while (held != NULL && access(held, F_OK) == 0)
        usleep(1000);
}

int fsync(int file)
{
    wait_for_the_disk();
    return syscall(SYS_fsync, file);
}

int fdatasync(int file)
{
    wait_for_the_disk();
    return syscall(SYS_fdatasync, file);
}

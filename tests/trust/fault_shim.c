/* Faults of the disk, by LD_PRELOAD: counts the operations that change files below a folder, and at the chosen one kills the
 * process in the middle of it, or lets it fail.
 *
 * Set by fault_arm(), for forked processes, and by environment variables, for the programs that they start:
 *   FAULT_FOLDER   folder, absolute
 *   FAULT_AT       number of the operation, from 1; 0 only counts
 *   FAULT_ERROR    errno with which it fails, or -9 to kill the process with SIGKILL
 *   FAULT_LASTING  1 if all later operations fail too, as on a full disk
 *   FAULT_COUNTER  file with the number of operations so far, shared by all processes
 * Files of TensorBoard are left alone: a thread of its own writes them, at any time.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { PATH_BYTES = 4096, KILL = -9 };

static char folder[PATH_BYTES];
static long fault_at;
static int fault_error, is_lasting;
static long* counter;

/* The function of the C library behind the one of the same name here. */
#define NEXT(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

void fault_arm(const char* path, long at, int error, int lasting, const char* counter_file) {
  int file = NEXT(open)(counter_file, O_RDWR | O_CREAT, 0600);
  if (file < 0 || ftruncate(file, sizeof(long)) < 0) abort();
  counter = mmap(NULL, sizeof(long), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
  if (counter == MAP_FAILED) abort();
  close(file);
  snprintf(folder, sizeof folder, "%s", path);
  fault_at = at, fault_error = error, is_lasting = lasting;
}

__attribute__((constructor)) static void arm_from_environment(void) {
  const char *path = getenv("FAULT_FOLDER"), *file = getenv("FAULT_COUNTER");
  const char *at = getenv("FAULT_AT"), *error = getenv("FAULT_ERROR"), *lasting = getenv("FAULT_LASTING");
  if (path && file && at && error && lasting) fault_arm(path, atol(at), atoi(error), atoi(lasting), file);
}

static int is_watched(const char* path) {
  size_t length = strlen(folder);
  return length && !strncmp(path, folder, length) && (path[length] == '/' || !path[length]) && !strstr(path, "tensorboard");
}

/* Return whether a path, relative to an open folder or to the current one (AT_FDCWD), is watched. */
static int is_path_watched(int at, const char* path) {
  char whole[2 * PATH_BYTES], link[64], base[PATH_BYTES];
  if (!folder[0] || !path) return 0;
  if (path[0] == '/') return is_watched(path);
  if (at == AT_FDCWD) {
    if (!getcwd(base, sizeof base)) return 0;
  } else {
    snprintf(link, sizeof link, "/proc/self/fd/%d", at);
    ssize_t length = readlink(link, base, sizeof base - 1);
    if (length <= 0) return 0;
    base[length] = 0;
  }
  snprintf(whole, sizeof whole, "%s/%s", base, path);
  return is_watched(whole);
}

static int is_file_watched(int file) {
  char link[64], path[PATH_BYTES];
  if (!folder[0]) return 0;
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  ssize_t length = readlink(link, path, sizeof path - 1);
  if (length <= 0) return 0;
  path[length] = 0;
  return is_watched(path);
}

/* Count one operation; return 1, with errno set, if it fails. `half`, if any, does a part of it before the process is killed.
 */
static int fails(void (*half)(void*), void* operation) {
  long number = __sync_add_and_fetch(counter, 1);
  if (!fault_at || number < fault_at || (number > fault_at && !is_lasting)) return 0;
  if (fault_error == KILL) {
    if (half) half(operation);
    kill(getpid(), SIGKILL);
    for (;;) pause();
  }
  errno = fault_error;
  return 1;
}

struct written {
  int file;
  const void* bytes;
  size_t size;
};

static void write_half(void* operation) {
  struct written* one = operation;
  if (one->size > 1 && NEXT(write)(one->file, one->bytes, one->size / 2) < 0) return;
}

ssize_t write(int file, const void* bytes, size_t size) {
  struct written one = {file, bytes, size};
  if (is_file_watched(file) && fails(write_half, &one)) return -1;
  return NEXT(write)(file, bytes, size);
}

ssize_t writev(int file, const struct iovec* parts, int count) {
  if (is_file_watched(file) && fails(NULL, NULL)) return -1;
  return NEXT(writev)(file, parts, count);
}

ssize_t pwrite64(int file, const void* bytes, size_t size, off64_t offset) {
  if (is_file_watched(file) && fails(NULL, NULL)) return -1;
  return NEXT(pwrite64)(file, bytes, size, offset);
}

int fsync(int file) {
  if (is_file_watched(file) && fails(NULL, NULL)) return -1;
  return NEXT(fsync)(file);
}

int ftruncate64(int file, off64_t size) {
  if (is_file_watched(file) && fails(NULL, NULL)) return -1;
  return NEXT(ftruncate64)(file, size);
}

static mode_t mode_of(int flags, va_list more) { return flags & (O_CREAT | O_TMPFILE) ? (mode_t)va_arg(more, int) : 0; }

#define OPENING(name)                                                              \
  int name(const char* path, int flags, ...) {                                     \
    va_list more;                                                                  \
    va_start(more, flags);                                                         \
    mode_t mode = mode_of(flags, more);                                            \
    va_end(more);                                                                  \
    int writes = (flags & O_ACCMODE) != O_RDONLY;                                  \
    if (writes && is_path_watched(AT_FDCWD, path) && fails(NULL, NULL)) return -1; \
    return NEXT(name)(path, flags, mode);                                          \
  }
OPENING(open)
OPENING(open64)

int rename(const char* from, const char* to) {
  if (is_path_watched(AT_FDCWD, to) && fails(NULL, NULL)) return -1;
  return NEXT(rename)(from, to);
}

int renameat(int from_at, const char* from, int to_at, const char* to) {
  if (is_path_watched(to_at, to) && fails(NULL, NULL)) return -1;
  return NEXT(renameat)(from_at, from, to_at, to);
}

int mkdir(const char* path, mode_t mode) {
  if (is_path_watched(AT_FDCWD, path) && fails(NULL, NULL)) return -1;
  return NEXT(mkdir)(path, mode);
}

/* A full disk lets files be deleted; so does this one. */
static int deletion_fails(void) { return fails(NULL, NULL) && fault_error != ENOSPC; }

int unlink(const char* path) {
  if (is_path_watched(AT_FDCWD, path) && deletion_fails()) return -1;
  return NEXT(unlink)(path);
}

int rmdir(const char* path) {
  if (is_path_watched(AT_FDCWD, path) && deletion_fails()) return -1;
  return NEXT(rmdir)(path);
}

int unlinkat(int at, const char* path, int flags) {
  if (is_path_watched(at, path) && deletion_fails()) return -1;
  return NEXT(unlinkat)(at, path, flags);
}

"""A wall around a process that reads a file of strangers: a C library that such a file misuses finds nothing behind it.

Three parts of Linux make the wall, and none can be taken down again by the process:

- Landlock (Linux 5.13 and later): of all files the process can open those that it may read, and the folders of the
  libraries' code. Files that are open already stay open.
- seccomp: the process cannot make sockets, start programs or processes, reach other processes, or change modes and
  times of files.
- A user of its own, if the service runs as root. Of the rights of root it keeps the one to read files, because its file
  and the code of the libraries may be readable for root alone; Landlock says which.

    raise_wall([path])
    walls()     # {"files": True, "calls": True, "user": True}

Sources: man pages landlock(7), seccomp(2), capabilities(7); include/uapi/linux/landlock.h and the tables of system
calls of Linux 6.12.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import site
import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446  # system calls, the same on every machine
_VERSION, _PATH_BENEATH = 1, 1
_READ_FILE, _READ_FOLDER = 1 << 2, 1 << 3
# The number of kinds of access to files that each version of Landlock knows.
_KINDS = {1: 13, 2: 14, 3: 15, 4: 15}
_LATEST_KINDS = 16
_SET_NO_NEW_PRIVS, _SET_SECCOMP, _FILTER = 38, 22, 2
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06  # instructions of BPF
_NUMBER_AT, _MACHINE_AT, _ARGUMENT_AT = 0, 4, 16  # in struct seccomp_data
_ALLOW, _REFUSE, _MISSING = 0x7FFF0000, 0x00050000 | errno.EPERM, 0x00050000 | errno.ENOSYS
_OTHER_NUMBERS = 0x40000000  # system calls of the x32 interface
_A_THREAD = 0x10000  # flag of clone
# For each machine: its number in the audit interface, and the system calls that are refused: sockets, programs, other
# processes, changes of files that need not be opened, and memory of other processes.
_MACHINES: dict[str, tuple[int, dict[str, int]]] = {
    "x86_64": (0xC000003E, {
        "shmget": 29, "shmat": 30, "socket": 41, "connect": 42, "accept": 43, "bind": 49, "listen": 50,
        "socketpair": 53, "fork": 57, "vfork": 58, "execve": 59, "kill": 62, "msgget": 68, "truncate": 76,
        "chmod": 90, "fchmod": 91, "chown": 92, "fchown": 93, "lchown": 94, "ptrace": 101, "rt_sigqueueinfo": 129,
        "utime": 132, "setpriority": 141, "chroot": 161, "mount": 165, "setxattr": 188, "lsetxattr": 189,
        "fsetxattr": 190, "tkill": 200, "sched_setaffinity": 203, "utimes": 235, "mq_open": 240, "add_key": 248,
        "request_key": 249, "keyctl": 250, "fchownat": 260, "futimesat": 261, "fchmodat": 268, "unshare": 272,
        "utimensat": 280, "accept4": 288, "rt_tgsigqueueinfo": 297, "perf_event_open": 298,
        "open_by_handle_at": 304, "setns": 308, "process_vm_readv": 310, "process_vm_writev": 311, "bpf": 321,
        "execveat": 322, "userfaultfd": 323, "pidfd_send_signal": 424, "io_uring_setup": 425, "pidfd_open": 434,
        "pidfd_getfd": 438, "fchmodat2": 452,
    }),
    "aarch64": (0xC00000B7, {
        "setxattr": 5, "lsetxattr": 6, "fsetxattr": 7, "mount": 40, "truncate": 45, "chroot": 51, "fchmod": 52,
        "fchmodat": 53, "fchownat": 54, "fchown": 55, "utimensat": 88, "unshare": 97, "ptrace": 117,
        "sched_setaffinity": 122, "kill": 129, "tkill": 130, "rt_sigqueueinfo": 138, "setpriority": 140,
        "mq_open": 180, "msgget": 186, "shmget": 194, "shmat": 196, "socket": 198, "socketpair": 199, "bind": 200,
        "listen": 201, "accept": 202, "connect": 203, "add_key": 217, "request_key": 218, "keyctl": 219,
        "execve": 221, "rt_tgsigqueueinfo": 240, "perf_event_open": 241, "accept4": 242, "open_by_handle_at": 265,
        "setns": 268, "process_vm_readv": 270, "process_vm_writev": 271, "bpf": 280, "execveat": 281,
        "userfaultfd": 282, "pidfd_send_signal": 424, "io_uring_setup": 425, "pidfd_open": 434, "pidfd_getfd": 438,
        "fchmodat2": 452,
    }),
}  # fmt: skip
# The numbers of clone, tgkill and prlimit64, which are allowed for threads and for the process itself, and of clone3.
_OF_ITSELF = {"x86_64": (56, 234, 302), "aarch64": (220, 131, 261)}
_CLONE3 = 435
_USER = 65534  # of the process, and its group: "nobody", who owns no file
_KEEP_CAPABILITIES, _READ_CAPABILITY, _CAPABILITIES_VERSION = 8, 1 << 2, 0x20080522
_up = {"files": False, "calls": False, "user": False}


class _Ruleset(ctypes.Structure):
    _fields_ = (("files", ctypes.c_uint64),)


class _Beneath(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("allowed", ctypes.c_uint64), ("folder", ctypes.c_int32))


class _Capabilities(ctypes.Structure):
    """The header of capset(2), and after it each of its three sets in two halves."""

    _fields_ = (("version", ctypes.c_uint32), ("process", ctypes.c_int32), ("sets", ctypes.c_uint32 * 6))


class _Instruction(ctypes.Structure):
    _fields_ = (
        ("code", ctypes.c_uint16),
        ("yes", ctypes.c_uint8),
        ("no", ctypes.c_uint8),
        ("value", ctypes.c_uint32),
    )


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_uint16), ("first", ctypes.POINTER(_Instruction)))


def raise_wall(files: Sequence[str | Path]) -> None:
    """Raise the wall around this process, as far as its kernel has the parts.

    Raises OSError if a part exists and cannot be raised, or a file cannot be opened.

    Parameters
    ----------
    files
        The files that the process may still open to read.
    """
    if sys.platform != "linux":
        return
    libc = ctypes.CDLL(None, use_errno=True)
    _called(libc.prctl(_SET_NO_NEW_PRIVS, 1, 0, 0, 0))
    _up["files"] = _close_files(libc, files)
    _up["user"] = _leave_root(libc, files)
    _up["calls"] = _close_calls(libc)


def walls() -> dict[str, bool]:
    """Which parts of the wall stand around this process."""
    return dict(_up)


def _called(result: int) -> int:
    """The result of a function of C. Raises OSError if it failed."""
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result


def _close_files(libc: ctypes.CDLL, files: Sequence[str | Path]) -> bool:
    version = libc.syscall(_CREATE_RULESET, None, 0, _VERSION)
    if version < 1:
        return False
    kinds = _Ruleset((1 << _KINDS.get(version, _LATEST_KINDS)) - 1)
    rules = _called(libc.syscall(_CREATE_RULESET, ctypes.byref(kinds), ctypes.sizeof(kinds), 0))
    for path in (*files, *_code()):
        here = os.open(path, os.O_PATH | os.O_CLOEXEC)
        allowed = _READ_FILE | (_READ_FOLDER if Path(path).is_dir() else 0)
        _called(libc.syscall(_ADD_RULE, rules, _PATH_BENEATH, ctypes.byref(_Beneath(allowed, here)), 0))
        os.close(here)
    _called(libc.syscall(_RESTRICT_SELF, rules, 0))
    os.close(rules)
    return True


def _leave_root(libc: ctypes.CDLL, files: Sequence[str | Path]) -> bool:
    """Become a user of its own, and say whether this process is root no more.

    It stays root in a container that allows no other user, and if only root can read the files, as on some network file
    systems.
    """
    if os.geteuid() != 0:
        return True
    try:
        os.setgroups([])
        os.setresgid(_USER, _USER, _USER)
        _called(libc.prctl(_KEEP_CAPABILITIES, 1, 0, 0, 0))
        os.setresuid(_USER, _USER, 0)
        wanted = _Capabilities(_CAPABILITIES_VERSION, 0, (_READ_CAPABILITY, _READ_CAPABILITY))
        sets = ctypes.byref(wanted, _Capabilities.sets.offset)
        _called(libc.capset(ctypes.byref(wanted), sets))
        for path in files:
            os.close(os.open(path, os.O_RDONLY))
    except OSError:
        os.setresuid(0, 0, 0)
        return False
    os.setresuid(_USER, _USER, _USER)
    return True


def _code() -> list[Path]:
    """The places of the code of Python and of its libraries: a function may import a module only when it needs it."""
    named = [
        *site.getsitepackages(),
        *(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
    ]
    of_system = ("/lib", "/lib64", "/usr/lib", "/usr/lib64", "/etc/ld.so.cache")
    places = {Path(one).resolve() for one in (*named, *of_system, str(Path(__file__).parent))}
    return sorted(one for one in places if one.exists())


def _close_calls(libc: ctypes.CDLL) -> bool:
    if platform.machine() not in _MACHINES:
        return False
    machine, refused = _MACHINES[platform.machine()]
    clone, tgkill, prlimit = _OF_ITSELF[platform.machine()]
    program = [
        (_LOAD, 0, 0, _MACHINE_AT),
        (_EQUAL, 1, 0, machine),
        (_RETURN, 0, 0, _REFUSE),
        (_LOAD, 0, 0, _NUMBER_AT),
        (_AT_LEAST, 0, 1, _OTHER_NUMBERS),
        (_RETURN, 0, 0, _REFUSE),
    ]
    for number in refused.values():
        program += [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, _REFUSE)]
    # The C library then uses clone, whose flags a filter can see.
    program += [(_EQUAL, 0, 1, _CLONE3), (_RETURN, 0, 0, _MISSING)]
    for number, test, value in (
        (clone, _ANY_BIT, _A_THREAD),
        (tgkill, _EQUAL, os.getpid()),
        (prlimit, _EQUAL, 0),
    ):
        program += [
            (_EQUAL, 0, 4, number),
            (_LOAD, 0, 0, _ARGUMENT_AT),
            (test, 1, 0, value),
            (_RETURN, 0, 0, _REFUSE),
            (_RETURN, 0, 0, _ALLOW),
        ]
    program.append((_RETURN, 0, 0, _ALLOW))
    instructions = (_Instruction * len(program))(*(_Instruction(*one) for one in program))
    if libc.prctl(_SET_SECCOMP, _FILTER, ctypes.byref(_Program(len(program), instructions)), 0, 0) == 0:
        return True
    if ctypes.get_errno() == errno.EINVAL:  # a kernel without seccomp
        return False
    raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))

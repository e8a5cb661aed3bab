"""Runs a command on a new terminal: terminal.py SECONDS KEY COLUMNSxROWS PROGRAM ARGUMENT...

After SECONDS and two pictures it types KEY, or sends the signal with that number. It prints the exit status, whether the settings of the
terminal are as before, and then what was shown.
"""
import fcntl
import os
import pty
import select
import struct
import sys
import termios
import time

seconds, key, size = float(sys.argv[1]), sys.argv[2], sys.argv[3]
columns, rows = map(int, size.split("x"))
parent, child = pty.openpty()
fcntl.ioctl(child, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
before = termios.tcgetattr(child)
pid = os.fork()
if pid == 0:
    os.setsid()
    fcntl.ioctl(child, termios.TIOCSCTTY, 0)
    for number in range(3):
        os.dup2(child, number)
    os.execv(sys.argv[4], sys.argv[4:])
shown, end, typed, status, pictures = b"", time.monotonic() + seconds, False, None, 2
while status is None:
    if select.select([parent], [], [], 0.05)[0]:
        shown += os.read(parent, 65536)
    # On a busy computer pictures come later.
    if not typed and time.monotonic() > end and shown.count(b"\x1b[H") >= pictures:
        typed = True
        if key.isdigit():
            os.kill(pid, int(key))
        elif key == "resize":
            fcntl.ioctl(child, termios.TIOCSWINSZ, struct.pack("HHHH", 10, 40, 0, 0))
            end, typed, key = time.monotonic() + seconds, False, "q"
            pictures = shown.count(b"\x1b[H") + 2
        else:
            os.write(parent, key.encode())
    ended, code = os.waitpid(pid, os.WNOHANG)
    status = code if ended else None
while select.select([parent], [], [], 0.2)[0]:
    shown += os.read(parent, 65536)
print(os.waitstatus_to_exitcode(status), termios.tcgetattr(child) == before)
sys.stdout.flush()
sys.stdout.buffer.write(shown)

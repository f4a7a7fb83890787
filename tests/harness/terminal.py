"""Commands on a terminal, as their users see them."""

import fcntl
import os
import pty
import struct
import subprocess
import sys
import termios


def on_terminal(*arguments, **environment):
    """What a Python process writes to a terminal of 24 rows and 80 columns; it has to end well.

    The terminal is read while the process writes: it holds no more than 4 kB.
    """
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    command = [sys.executable, *arguments]
    process = subprocess.Popen(command, stdout=slave, stderr=slave, env={**os.environ, **environment})
    os.close(slave)
    output = b""
    try:
        while part := os.read(master, 4096):
            output += part
    except OSError:  # the other end is closed
        pass
    os.close(master)
    assert process.wait() == 0, output.decode()
    return output.decode()

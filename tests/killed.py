"""Processes killed at a write: what SIGKILL leaves in a folder, without a separate process."""

from jaxlfi.io import files as atomic


class Killed(BaseException):
    """The process dies here."""


def kill_at(monkeypatch, nth: int, midway: bool):
    """Make the nth write to a file the process's last act; `midway` leaves half of it: a .part file, or half a line."""
    write_bytes, append_line, count = atomic.write_bytes, atomic.append_line, [0]

    def write(path, content, durable=False):
        count[0] += 1
        if count[0] == nth and midway:
            path.with_name(path.name + ".part").write_bytes(content[: len(content) // 2])
            raise Killed
        write_bytes(path, content, durable)
        if count[0] == nth:
            raise Killed

    def append(path, line):
        count[0] += 1
        append_line(path, line[: len(line) // 2] if count[0] == nth and midway else line)
        if count[0] == nth:
            raise Killed

    monkeypatch.setattr(atomic, "write_bytes", write)
    monkeypatch.setattr(atomic, "append_line", append)

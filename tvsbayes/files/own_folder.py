"""A folder that only its user can have written, with sealed files that may be executed later.

A file begins with a magic number and the SHA-256 of its name and content: one under another's name is none. It is read
only where file and folder belong to the user of this process and nobody else may write them (POSIX; Windows separates
users' folders by itself). A cache that cannot be read or written is no error: the caller computes its content again.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import stat
from dataclasses import dataclass
from pathlib import Path

MAGIC = b"tvsbayes sealed 2\n"
OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def _seal(name: str, content: bytes) -> bytes:
    return MAGIC + hashlib.sha256(name.encode() + b"\n" + content).digest()


def _others_may_change(status: os.stat_result) -> bool:
    return os.name == "posix" and (status.st_uid != os.geteuid() or bool(status.st_mode & OTHERS_WRITE))


@dataclass(frozen=True)
class OwnFolder:
    """A folder of sealed files.

    Attributes:
        path: path of the folder; `make` creates it.
        file_bytes_max: larger files are not read.
        bytes_max: largest total size; `write` removes the files used longest ago.
    """

    path: Path
    file_bytes_max: int = 16 * 2**20
    bytes_max: int = 128 * 2**20

    def fault(self) -> str:
        """Why the folder cannot be trusted, in words; "" where it can."""
        try:
            status = os.lstat(self.path)
        except FileNotFoundError:
            return "it does not exist"
        except OSError as error:
            return error.strerror or "it cannot be read"
        if not stat.S_ISDIR(status.st_mode):
            return "it is no folder"
        if os.name == "posix" and status.st_uid != os.geteuid():
            return "it belongs to another user"
        return "others may write into it" if _others_may_change(status) else ""

    def make(self) -> str:
        """Create the folder for this user alone where it is missing; returns `fault`."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.path.mkdir(mode=0o700, exist_ok=True)
        except OSError as error:
            return error.strerror or "it cannot be created"
        return self.fault()

    def read(self, name: str) -> bytes | None:
        """The content of a sealed file; None where it is missing, damaged, too large or perhaps of another user."""
        if self.fault():
            return None
        try:
            flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
            descriptor = os.open(self.path / name, flags | getattr(os, "O_BINARY", 0))
            with open(descriptor, "rb") as stream:
                status = os.fstat(descriptor)
                if not stat.S_ISREG(status.st_mode) or _others_may_change(status):
                    return None
                data = stream.read(self.file_bytes_max + 1)
            # The time of last use, by which `write` chooses the files to remove.
            os.utime(self.path / name)
        except OSError:
            return None
        seal, content = data[: len(MAGIC) + 32], data[len(MAGIC) + 32 :]
        intact = len(data) <= self.file_bytes_max and seal == _seal(name, content)
        return content if intact else None

    def write(self, name: str, content: bytes) -> bool:
        """Write a sealed file, completely or not at all; True where it was written."""
        data = _seal(name, content) + content
        if self.make() or len(data) > self.file_bytes_max:
            return False
        temporary = self.path / f".{secrets.token_hex(8)}.tmp"
        try:
            with open(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as stream:
                stream.write(data)
            os.replace(temporary, self.path / name)
        except OSError:
            temporary.unlink(missing_ok=True)
            return False
        self._prune()
        return True

    def _prune(self) -> None:
        """Remove the files used longest ago until the rest fits `bytes_max`."""
        try:
            files = [(entry.stat(), Path(entry.path)) for entry in os.scandir(self.path) if entry.is_file()]
            total = sum(status.st_size for status, _ in files)
            for status, path in sorted(files, key=lambda file: file[0].st_mtime):
                if total <= self.bytes_max:
                    break
                path.unlink(missing_ok=True)
                total -= status.st_size
        except OSError:
            # Another process may be removing the same files.
            return

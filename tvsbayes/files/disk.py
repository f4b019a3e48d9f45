"""Read bytes and arrays under a size limit, and write files completely or not at all.

A reader returns the content of a regular file inside its folder, or raises `InputError` with file, line, the value
found, the allowed values and the remedy. Sizes are checked before anything is read or unpacked. The module does not
depend on the content of campaigns; lines count from 1.
"""

from __future__ import annotations

import errno
import glob
import io
import math
import os
import re
import secrets
import shutil
import stat
import sys
import zipfile
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from tvsbayes.errors import CONTROL, InputError, escaped, refusal, shown

if TYPE_CHECKING:
    import numpy as np

FLUSHES_NO_FOLDER = frozenset({errno.EINVAL, errno.ENOTSUP})
"""Errors of file systems (some network shares) that flush files only, fsync(2); folders cannot be flushed there."""
RESULTS_BYTES_MAX = 128 * 1024 * 1024
"""Largest size of a file of results, and of its unpacked arrays."""
ARRAYS_MAX = 256
LOCKED_BYTE = 2**40
_NPY_HEADER = re.compile(
    rb"\x93NUMPY\x01\x00(?P<length>..)\{'descr': '(?P<kind>[<>|][biufU][0-9]{1,8})', 'fortran_order': "
    rb"(?P<fortran>True|False), 'shape': \((?P<shape>[0-9, ]{0,100})\),? ?\} *\n",
    re.DOTALL,
)
"""Version 1.0 of the header (NEP 1) as NumPy writes it; the pattern reads it without evaluating code."""


def read_bytes(path: Path, cap: int, folder: Path | None = None) -> bytes:
    """Read a regular file of at most `cap` bytes.

    Args:
        path: the file.
        cap: largest size, bytes; checked before reading.
        folder: where given, the file must lie inside it after following links.

    Raises:
        InputError: missing, unreadable, not a regular file, outside `folder` or too large.
    """
    allowed = f"a readable file of at most {cap} bytes"
    with opened(path, allowed, folder) as stream:
        size = os.fstat(stream.fileno()).st_size
        if size > cap:
            raise _too_large(path, f"{size} bytes", allowed)
        # The cap itself as size of the read would be allocated for every file.
        data = stream.read(size + 1)
        if len(data) > size:
            data += stream.read(cap + 1 - len(data))
    if len(data) > cap:
        raise _too_large(path, f"more than {cap} bytes", allowed)
    return data


def require_campaign_folder(folder: Path, kind: str) -> None:
    """Refuse a path that is no folder; `kind` is the kind of folder wanted, in words."""
    if not folder.is_dir():
        found = "no such folder" if not folder.exists() else "a file"
        place, remedy = escaped(str(folder), 200), "give the folder that holds campaign.toml"
        raise refusal("missing-file", file=place, found=found, allowed=kind, remedy=remedy)


def _too_large(path: Path, found: str, allowed: str) -> InputError:
    remedy = "split the data or remove what is not needed"
    return refusal("size", file=escaped(Path(path).name), found=found, allowed=allowed, remedy=remedy)


@contextmanager
def opened(path: Path, allowed: str, folder: Path | None = None) -> Iterator[BinaryIO]:
    """Open a regular file for reading.

    Args:
        path: the file.
        allowed: the allowed files, for messages.
        folder: where given, the file must lie inside it after following links.

    Raises:
        InputError: missing, unreadable, not a regular file, outside `folder`, or reading it fails.
    """
    path = Path(path)
    file = escaped(path.name) or escaped(str(path))

    def refuse(code: str, found: str, remedy: str) -> InputError:
        return refusal(code, file=file, found=found, allowed=allowed, remedy=remedy)

    try:
        real = path.resolve(strict=True)
        if folder is not None and not real.is_relative_to(Path(folder).resolve()):
            raise refuse("path", "a link that leaves the folder", "put the file itself into the folder")
        # Without O_NONBLOCK the opening of a pipe would wait for a writer without end.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOFOLLOW", 0)
        descriptor = os.open(real, flags | getattr(os, "O_BINARY", 0))
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise refuse("not-a-file", "a folder, pipe or device", "name a regular file")
            with open(descriptor, "rb", closefd=False) as stream:
                yield stream
        finally:
            os.close(descriptor)
    except FileNotFoundError as error:
        remedy = f"create it, or correct {escaped(str(path), 200)}"
        if Path(path).name == "stereo.json":
            remedy = (
                "`tvsbayes stereo` makes one of pictures, of OpenCV's, ROS' or Kalibr's calibration, or of nominal "
                f"numbers; {remedy}"
            )
        raise refuse("missing-file", "no such file", remedy) from error
    except (OSError, ValueError) as error:
        reason = escaped(getattr(error, "strerror", None) or str(error))
        raise refuse("unreadable", reason, "check the path and its permissions") from error


def line_in_file(number: int, skipped: int) -> int:
    """Line number in a file of line `number` of a text from which `skipped` lines after the first were left out."""
    return number + (skipped if number > 1 else 0)


def decode(data: bytes, file: str, skipped: int = 0) -> str:
    """Decode UTF-8 text with or without BOM; refuse other encodings, NUL and other control characters.

    Args:
        data: the text, or its first line and the lines after those left out.
        file: its name, for errors.
        skipped: number of lines left out after the first.

    Raises:
        InputError: names the line in the file.
    """
    refuse = partial(refusal, file=file)
    utf16 = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = None if utf16 else line_in_file(data.count(b"\n", 0, error.start) + 1, skipped)
        found = "UTF-16" if utf16 else f"the byte 0x{data[error.start]:02x}"
        allowed, remedy = "UTF-8 text", "save it as UTF-8"
        raise refuse("encoding", line=line, found=found, allowed=allowed, remedy=remedy) from error
    if control := CONTROL.search(text):
        line = line_in_file(text.count("\n", 0, control.start()) + 1, skipped)
        found = shown(control.group())
        raise refuse("control-character", line=line, found=found, allowed="printable text", remedy="remove it")
    return text


def flush_folder(folder: Path, disk: Any = os) -> None:
    """Make the names in a folder durable, where the system allows it: only POSIX flushes folders.

    Args:
        folder: the folder.
        disk: has `open`, `fsync` and `close` of the operating system.

    Raises:
        OSError: the disk failed.
    """
    if os.name != "posix":
        return
    descriptor = disk.open(folder, os.O_RDONLY)
    try:
        disk.fsync(descriptor)
    except OSError as error:
        if error.errno not in FLUSHES_NO_FOLDER:
            raise
    finally:
        disk.close(descriptor)


OTHER_PLACE = "name another place or free this one"
NEW_FOLDER = "a new or empty folder"
UNFINISHED = re.compile(r"\.new\.[0-9a-f]{12}\.tmp$")
"""What a killed `new_folder` leaves in an existing folder."""


def unwritable(path: Path, error: OSError, allowed: str, remedy: str) -> InputError:
    """The refusal of a place that cannot be written."""
    found = escaped(error.strerror or str(error))
    return refusal("write", file=escaped(str(path), 200), found=found, allowed=allowed, remedy=remedy)


def write_atomically(path: Path, data: bytes) -> None:
    """Replace `path` by `data` so that a reader, or a crash, leaves the old file or the new one, never a part.

    Raises:
        InputError: as `written_whole`.
    """
    with written_whole(path) as stream:
        stream.write(data)


def write_together(folder: Path, contents: Mapping[str, bytes | None]) -> None:
    """Replace files of a folder in their order, once all are on the disk beside their places; None removes a file.

    Raises:
        InputError: the folder is missing, full or not writable.
    """
    prepared = {name: folder / _temporary(name) for name, data in contents.items() if data is not None}
    try:
        try:
            for name, path in prepared.items():
                with open(path, "xb") as stream:
                    stream.write(contents[name] or b"")
                    stream.flush()
                    os.fsync(stream.fileno())
            for name in contents:
                if name in prepared:
                    os.replace(prepared[name], folder / name)
                else:
                    (folder / name).unlink(missing_ok=True)
        finally:
            for path in prepared.values():
                path.unlink(missing_ok=True)
        flush_folder(folder)
    except OSError as error:
        raise unwritable(folder, error, "a writable folder with free space", OTHER_PLACE) from error


def _temporary(name: str) -> str:
    return f".{name}.{secrets.token_hex(6)}.tmp"


@contextmanager
def written_whole(path: Path) -> Iterator[BinaryIO]:
    """Open a stream that replaces `path` when its block ends without an error; else `path` stays unchanged.

    Raises:
        InputError: the folder is missing, full or not writable; `path` is then the old file, or the new one where only
            the flush of the folder failed.
    """
    path = Path(path)
    temporary = path.with_name(_temporary(path.name))
    try:
        try:
            with open(temporary, "xb") as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        # The new name is durable only once its folder is flushed.
        flush_folder(path.parent)
    except OSError as error:
        raise unwritable(path, error, "a writable folder with free space", OTHER_PLACE) from error


def locked(descriptor: int) -> bool:
    """Lock an open file for this process; False where another one holds it. The lock ends with the process.

    Raises:
        OSError: the disk cannot lock files.
    """
    try:
        if sys.platform == "win32":
            import msvcrt

            # The lock lies far beyond the end, so that readers are not locked out.
            os.lseek(descriptor, LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        # Errors of flock(2) and _locking for a held lock.
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK):
            return False
        raise
    return True


def remove_unfinished(folder: Path, names: Iterable[str]) -> list[str]:
    """Remove temporary files of these names that a killed `write_atomically` left behind.

    Use it only for a folder into which no other process writes these files.

    Returns:
        Names of the temporary files that were removed.
    """
    removed = []
    for name in names:
        for path in sorted(Path(folder).glob(f".{glob.escape(name)}.{'[0-9a-f]' * 12}.tmp")):
            path.unlink(missing_ok=True)
            removed.append(path.name)
    return removed


def make_folder(folder: Path, *, empty: bool = False, but: Collection[str] = ()) -> None:
    """Create a folder and its parents.

    Args:
        folder: the folder.
        empty: refuse a folder that is not empty, so that nothing is overwritten.
        but: names of files that an empty folder may contain.

    Raises:
        InputError: the folder cannot be created, or is not empty.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        occupied = empty and any(path.name not in but and not UNFINISHED.match(path.name) for path in folder.iterdir())
    except OSError as error:
        raise unwritable(folder, error, NEW_FOLDER, "name another") from error
    if occupied:
        raise _occupied(folder)


def _occupied(folder: Path) -> InputError:
    file, remedy = escaped(str(folder), 200), "name another folder; nothing is overwritten"
    return refusal("occupied", file=file, found="a folder with files", allowed=NEW_FOLDER, remedy=remedy)


@contextmanager
def new_folder(to: Path, *, but: Collection[str] = ()) -> Iterator[Path]:
    """Prepare the files of a new folder beside it; at the end of the block they are all there, or none of them.

    Of two processes with one new folder, one wins whole and the other is refused. Yields the folder to write into.

    Args:
        to: a new folder, or an empty one.
        but: names of files that the empty folder may contain.

    Raises:
        InputError: the folder cannot be created, or is not empty.
    """
    to = Path(to)
    is_new = not to.exists()
    make_folder(to.absolute().parent if is_new else to, empty=not is_new, but=but)
    prepared = to.with_name(_temporary(to.name)) if is_new else to / _temporary("new")
    try:
        prepared.mkdir()
        try:
            yield prepared
            for folder, _, _ in os.walk(prepared):
                flush_folder(Path(folder))
            if is_new:
                os.rename(prepared, to)
            else:
                _move_into(prepared, to)
        finally:
            shutil.rmtree(prepared, ignore_errors=True)
        flush_folder(to.absolute().parent if is_new else to)
    except OSError as error:
        if error.errno in (errno.EEXIST, errno.ENOTEMPTY):
            raise _occupied(to) from error
        raise unwritable(to, error, NEW_FOLDER, "name another") from error
    except InputError as error:
        if error.code != "write":
            raise
        # It names the place beside.
        raise unwritable(to, OSError(error.found), NEW_FOLDER, "name another") from error


def write_folder(to: Path, files: Mapping[str, bytes], *, but: Collection[str] = ()) -> list[str]:
    """Write files by name into a new folder, all or none; arguments and errors as of `new_folder`. Returns paths."""
    with new_folder(to, but=but) as prepared:
        for name, data in files.items():
            write_atomically(prepared / name, data)
    return [str(Path(to) / name) for name in files]


def _move_into(prepared: Path, to: Path) -> None:
    """Move files into an existing folder; creating the first of them alone decides which of two processes wins."""
    names = sorted(path.name for path in prepared.iterdir())
    for name in names[:1]:
        (to / name).touch(exist_ok=False)
    for name in names:
        os.replace(prepared / name, to / name)


def require_writable(folder: Path) -> None:
    """Refuse a folder for results that cannot be written, before the work starts; the test leaves no file.

    Args:
        folder: the folder; if it is missing, its nearest existing parent is tested.

    Raises:
        InputError: no file can be written there.
    """
    import tempfile

    folder = Path(folder)
    try:
        tempfile.TemporaryFile(dir=next(path for path in (folder, *folder.absolute().parents) if path.exists())).close()
    except OSError as error:
        remedy = "free it, or name another place where the command has --out"
        raise unwritable(folder, error, "a folder that can be written", remedy) from error


def output_place(folder: Path, *names: str) -> Path:
    """Return `folder / names`, checked: no link leads out of the folder.

    Raises:
        InputError: a link inside the folder leads elsewhere: a foreign folder must not choose where files are written.
    """
    path = Path(folder).joinpath(*names)
    try:
        inside = path.resolve().is_relative_to(Path(folder).resolve())
    except (OSError, RuntimeError):
        inside = False
    if not inside:
        shown_path, allowed = escaped(str(path), 200), "a folder inside the campaign"
        remedy = "remove the link, or name the place for results with --out where the command has it"
        raise refusal("path", file=shown_path, found="a link that leaves it", allowed=allowed, remedy=remedy)
    return path


def shipped_data() -> Path:
    """The folder of twins, rigs, templates and reference values that is shipped with the package.

    In a wheel it lies inside the package; in a checkout or an editable install beside the package.
    """
    packaged = Path(str(resources.files("tvsbayes") / "data"))
    return packaged if packaged.is_dir() else Path(str(resources.files("tvsbayes"))).resolve().parent / "data"


def array_of(content: bytes, name: str) -> np.ndarray:
    """Read the array of an .npy; anything but numbers and text of exactly the header's size raises ValueError."""
    import numpy as np

    match = _NPY_HEADER.match(content)
    if match is None or match.end() != 10 + int.from_bytes(match["length"], "little"):
        raise ValueError(f"{name} is no array of numbers or text")
    shape = tuple(int(length) for length in match["shape"].replace(b" ", b"").split(b",") if length)
    try:
        dtype = np.dtype(match["kind"].decode())
    except TypeError as error:
        raise ValueError(f"{name} is of the kind {match['kind'].decode()}") from error
    if len(shape) > 8 or not dtype.itemsize or math.prod(shape) * dtype.itemsize != len(content) - match.end():
        raise ValueError(f"{name} is not as long as its header says")
    array = np.frombuffer(content, dtype, offset=match.end())
    return array.reshape(shape, order="F" if match["fortran"] == b"True" else "C").copy()


def read_arrays(path: Path, bytes_max: int) -> dict[str, np.ndarray]:
    """Read the arrays of an .npz; see `arrays_of`.

    Raises:
        InputError: as `read_bytes`.
        ValueError: as `arrays_of`.
    """
    return arrays_of(read_bytes(path, bytes_max), bytes_max)


def arrays_of(data: bytes, bytes_max: int) -> dict[str, np.ndarray]:
    """The arrays of an .npz, by name; every size is checked against the header before memory is allocated.

    `numpy.load` alone can expand 0.5 kB to gigabytes: by entries of no width, and by bzip2 members, which zipfile
    unpacks without a limit whatever size they state.

    Raises:
        ValueError: not an .npz of plain numbers and text as NumPy writes it, or above `bytes_max`, packed or unpacked.
    """
    arrays = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if len(members) > ARRAYS_MAX or sum(member.file_size for member in members) > bytes_max:
                raise ValueError(f"more than {ARRAYS_MAX} arrays or {bytes_max} bytes when unpacked")
            for member in members:
                if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise ValueError("an array that is packed in another way than numpy packs it")
                with archive.open(member) as stream:
                    content = stream.read(member.file_size)
                name = member.filename.removesuffix(".npy")
                if name in arrays:
                    raise ValueError(f"{escaped(name)} twice")
                arrays[name] = array_of(content, escaped(name))
    except ValueError:
        raise
    except (OSError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError) as error:
        raise ValueError(escaped(str(error), 120)) from error
    return arrays

"""A sealed archive: a zip whose bytes depend only on its content, with a list of the hashes of its members.

Members are stored uncompressed, in a fixed order, dated 1980. ``manifest.json`` comes first and lists each of the
others with its SHA-256. This is not a signature: a changed member with a changed list makes another valid archive, but
its own hash (``seal``) is different.
"""

from __future__ import annotations

import hashlib
import io
import json
import struct
import zipfile
from collections.abc import Mapping

from go1exp.base.errors import Expected

MANIFEST = "manifest.json"
FORMAT = 1


class BundleError(Expected):
    """A bundle that is refused; the message names the file, the member and the problem."""


def seal(data: bytes) -> str:
    """Return the SHA-256 of ``data``, 64 hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def as_json(content: object) -> bytes:
    """Write plain data as JSON, the same bytes for the same data; NaN and infinities are refused with ValueError."""
    return (json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def stored(members: Mapping[str, bytes]) -> bytes:
    """Return a zip of ``members`` in their order: not compressed, so that no library's version is in the bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, content in members.items():
            info = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            # Unix and rw-r--r--, whatever the system: both are in the bytes.
            info.create_system, info.external_attr = 3, 0o644 << 16
            archive.writestr(info, content)
    return buffer.getvalue()


def pack(members: Mapping[str, bytes]) -> bytes:
    """Return the sealed archive of ``members`` in their order."""
    hashes = {name: seal(content) for name, content in members.items()}
    return stored({MANIFEST: as_json({"format": FORMAT, "sha256": hashes}), **members})


def unpack(data: bytes, members: tuple[str, ...], source: str) -> dict[str, bytes]:
    """Return the content of a sealed archive by name.

    Args:
        data: the archive.
        members: what must be in it, in order; nothing else may.
        source: name of it in messages.

    Raises:
        BundleError: if it is not such an archive, or its content is not what was packed.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            infos = archive.infolist()
            # Python's reader accepts an archive with other bytes before or after it; these are refused here.
            if infos[0].header_offset or archive.comment or data[-22:-18] != b"PK\5\6":
                raise BundleError(f"{source}: not a bundle, or damaged (bytes before or after the archive)")
            _check_names([info.filename for info in infos], members, source)
            contents = {info.filename: _member(archive, info, source) for info in infos}
    except (zipfile.BadZipFile, IndexError, OSError, struct.error, NotImplementedError, RuntimeError) as error:
        if isinstance(error, BundleError):
            raise
        raise BundleError(f"{source}: not a bundle, or damaged ({error})") from None
    hashes = _hashes(contents.pop(MANIFEST), members, source)
    for name, content in contents.items():
        if seal(content) != hashes[name]:
            raise BundleError(f"{source}: {name}: its SHA-256 is {seal(content)}, {MANIFEST} says {hashes[name]}")
    return contents


def _check_names(names: list[str], members: tuple[str, ...], source: str) -> None:
    """Refuse members that are missing, too many, doubled or in another order."""
    wanted = [MANIFEST, *members]
    for name in wanted:
        if name not in names:
            raise BundleError(f"{source}: {name}: missing")
    for name in names:
        if name not in wanted:
            raise BundleError(f"{source}: {name}: does not belong there")
        if names.count(name) > 1:
            raise BundleError(f"{source}: {name}: is there {names.count(name)} times")
    if names != wanted:
        raise BundleError(f"{source}: members in the order {', '.join(names)} instead of {', '.join(wanted)}")


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, source: str) -> bytes:
    if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 0x1:
        raise BundleError(f"{source}: {info.filename}: compressed or encrypted, which go1exp export never does")
    try:
        return archive.read(info)
    except (zipfile.BadZipFile, OSError, EOFError, struct.error) as error:
        raise BundleError(f"{source}: {info.filename}: damaged ({error})") from None


def _hashes(manifest: bytes, members: tuple[str, ...], source: str) -> dict[str, str]:
    """Return the hashes of the manifest, which must have these and nothing else."""
    try:
        content = json.loads(manifest)
    except ValueError as error:
        raise BundleError(f"{source}: {MANIFEST}: no JSON ({error})") from None
    if not isinstance(content, dict) or content.keys() != {"format", "sha256"}:
        raise BundleError(f"{source}: {MANIFEST}: must hold format and sha256, and nothing else")
    if content["format"] != FORMAT:
        raise BundleError(f"{source}: {MANIFEST}: format {content['format']!r}, this version reads {FORMAT}")
    hashes = content["sha256"]
    if not isinstance(hashes, dict) or list(hashes) != list(members):
        raise BundleError(f"{source}: {MANIFEST}: must give the SHA-256 of {', '.join(members)}")
    return hashes

"""The bundle: everything of a training run that the robot's computer needs, in one sealed archive.

Members: ``metadata.json`` (``metadata.py``), ``config.json`` (the run's resolved configuration), ``versions.json``,
``policy.onnx`` and ``trace.npz`` (inputs and outputs of the policy in simulation, replayed when the bundle is loaded).

The archive is a zip whose bytes depend only on its content: members are stored uncompressed, in a fixed order, dated
1980. ``manifest.json`` comes first and lists the SHA-256 of each other member. This is not a signature.
"""

from __future__ import annotations

import hashlib
import io
import json
import struct
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from go1exp.base.errors import Unusable
from go1exp.deploy.runtime.metadata import Metadata
from go1exp.deploy.runtime.policy import OnnxPolicy

MANIFEST = "manifest.json"
FORMAT = 1


class BundleError(Unusable):
    """An invalid bundle; the message names the file, the member and the problem."""


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
        members: required ones, in order.
        source: its name in messages.

    Raises:
        BundleError: if it is not such an archive, or its content has changed.
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
            raise BundleError(f"{source}: {name}: its SHA-256 is {seal(content)}, that of {MANIFEST} {hashes[name]}")
    return contents


def _check_names(names: list[str], members: tuple[str, ...], source: str) -> None:
    """Refuse missing, unexpected, duplicate or misordered members."""
    wanted = [MANIFEST, *members]
    for name in wanted:
        if name not in names:
            raise BundleError(f"{source}: {name}: missing")
    for name in names:
        if name not in wanted:
            raise BundleError(f"{source}: {name}: unexpected member")
        if names.count(name) > 1:
            raise BundleError(f"{source}: {name}: duplicate")
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
    """Return the hashes of the manifest, which must have exactly these keys."""
    content = _json(manifest, f"{source}: {MANIFEST}")
    if content.keys() != {"format", "sha256"}:
        raise BundleError(f"{source}: {MANIFEST}: must have format and sha256 alone")
    if content["format"] != FORMAT:
        raise BundleError(f"{source}: {MANIFEST}: format {content['format']!r}, this version reads {FORMAT}")
    hashes = content["sha256"]
    if not isinstance(hashes, dict) or list(hashes) != list(members):
        raise BundleError(f"{source}: {MANIFEST}: must give the SHA-256 of {', '.join(members)}")
    return hashes


METADATA, CONFIG, VERSIONS, POLICY, TRACE = "metadata.json", "config.json", "versions.json", "policy.onnx", "trace.npz"
MEMBERS = (METADATA, CONFIG, VERSIONS, POLICY, TRACE)

TOLERANCE = 1e-5
"""Largest difference of a replayed output from the recorded one: rad, and the unit of each observation."""


@dataclass(frozen=True)
class Bundle:
    """A bundle whose policy has reproduced the outputs of simulation.

    Attributes:
        source: the file.
        seal: SHA-256 of the whole file.
        sizes: bytes by member.
        metadata: description of the policy.
        config: the run's own resolved configuration.
        versions: versions of the packages that trained and exported it.
        policy: sensor readings in, joint targets out.
        trace: ``input.NAME`` and ``output.NAME`` (rows, size) float32, and ``time`` (rows,) float64, s.
        differences: largest difference of each output in the replay, by name.
    """

    source: str
    seal: str
    sizes: dict[str, int]
    metadata: Metadata
    config: dict[str, Any]
    versions: dict[str, Any]
    policy: OnnxPolicy
    trace: dict[str, np.ndarray]
    differences: dict[str, float]


def write(
    metadata: Metadata,
    config: Mapping[str, Any],
    versions: Mapping[str, Any],
    policy: bytes,
    trace: Mapping[str, np.ndarray],
) -> bytes:
    """Return the bundle's bytes: the same for the same content.

    Raises:
        ValueError: if the data hold values that JSON does not have.
    """
    documents = {METADATA: metadata.as_dict(), CONFIG: config, VERSIONS: versions}
    return pack({**{name: as_json(content) for name, content in documents.items()}, POLICY: policy, TRACE: _npz(trace)})


def load(path: str | Path) -> Bundle:
    """Read a bundle and replay its trace.

    Raises:
        BundleError: if it is not a bundle, a member has changed, or the policy gives other outputs here.
        OSError: if the file cannot be read.
    """
    return loads(Path(path).read_bytes(), str(path))


def loads(data: bytes, source: str) -> Bundle:
    """Read a bundle from its bytes; ``source`` is its name in messages. Errors as ``load``'s."""
    members = unpack(data, MEMBERS, source)
    try:
        metadata = Metadata.from_dict(_json(members[METADATA], f"{source}: {METADATA}"))
    except ValueError as error:
        raise BundleError(f"{source}: {METADATA}: {error}") from None
    try:
        policy = OnnxPolicy(members[POLICY], metadata.inputs, metadata.outputs)
    except ValueError as error:
        raise BundleError(f"{source}: {POLICY}: {error}") from None
    trace = _trace(members[TRACE], metadata, source)
    _check_action(trace, metadata, source)
    return Bundle(
        source=source,
        seal=seal(data),
        sizes={name: len(content) for name, content in members.items()},
        metadata=metadata,
        config=_json(members[CONFIG], f"{source}: {CONFIG}"),
        versions=_json(members[VERSIONS], f"{source}: {VERSIONS}"),
        policy=policy,
        trace=trace,
        differences=replay(policy, trace, source),
    )


def replay(policy: OnnxPolicy, trace: Mapping[str, np.ndarray], source: str) -> dict[str, float]:
    """Run the policy on the recorded readings, row by row as on the robot; return the largest difference per output.

    Raises:
        BundleError: if one exceeds ``TOLERANCE`` or is not a number.
    """
    rows = len(trace["time"])
    inputs = {port.name: trace[f"input.{port.name}"] for port in policy.inputs}
    steps = [policy({name: values[k : k + 1] for name, values in inputs.items()}) for k in range(rows)]
    differences = {}
    for port in policy.outputs:
        got = np.concatenate([step[port.name] for step in steps])
        off = np.abs(got.astype(np.float64) - trace[f"output.{port.name}"])
        worst = float(np.max(off))  # NaN if anything is
        if not worst <= TOLERANCE:  # true for NaN as well
            at = np.unravel_index(np.argmax(np.nan_to_num(off, nan=np.inf)), off.shape)
            replayed, then = got[at], trace[f"output.{port.name}"][at]
            raise BundleError(
                f"{source}: {TRACE}: {port.name}[{at[1]}] at {trace['time'][at[0]]:.2f} s is {replayed:.6g} here and "
                f"{then:.6g} in the trace; they may differ by {TOLERANCE:g}"
            )
        differences[port.name] = worst
    return differences


def _check_action(trace: Mapping[str, np.ndarray], metadata: Metadata, source: str) -> None:
    """Refuse metadata that map the recorded actions to other targets."""
    action, target = (trace[f"output.{name}"].astype(np.float64) for name in ("action", "joint_target"))
    meant = np.asarray(metadata.nominal_stance) + metadata.action_scale * action
    if not float(np.max(np.abs(meant - target))) <= TOLERANCE:
        raise BundleError(f"{source}: {METADATA}: nominal_stance and action_scale are not those of the trace")
    if not float(np.max(np.abs(action))) <= metadata.action_clip + TOLERANCE:
        raise BundleError(f"{source}: {METADATA}: action_clip is not that of the trace")
    if metadata.action_max_step is not None:
        bounding = (trace.get(f"input.{name}_action", np.inf) for name in ("lowest", "highest"))
        change = metadata.action_scale * np.stack([np.abs(action - one) for one in bounding])
        if not float(np.max(change)) <= metadata.action_max_step + TOLERANCE:
            raise BundleError(f"{source}: {METADATA}: action_max_step is not that of the trace")


def _json(content: bytes, where: str) -> dict[str, Any]:
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise BundleError(f"{where}: invalid JSON ({error})") from None
    if not isinstance(document, dict):
        raise BundleError(f"{where}: must be a mapping")
    return document


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return NumPy's archive of ``arrays``, which ``numpy.load`` reads; the same bytes for the same arrays."""
    members = {}
    for name, values in arrays.items():
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, np.ascontiguousarray(values), version=(1, 0), allow_pickle=False)
        members[f"{name}.npy"] = buffer.getvalue()
    return stored(members)


def _trace(content: bytes, metadata: Metadata, source: str) -> dict[str, np.ndarray]:
    """Return the finite arrays of the trace: the metadata's inputs and outputs."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name]) for name in file.files}
    except Exception as error:  # damage of a zip and of the arrays in it has many forms
        raise BundleError(f"{source}: {TRACE}: not NumPy's arrays ({error})") from None
    ports = {"input": metadata.inputs, "output": metadata.outputs}
    sizes = {f"{kind}.{port.name}": port.size for kind, group in ports.items() for port in group}
    if arrays.keys() != {"time", *sizes}:
        odd = ", ".join(sorted(arrays.keys() ^ {"time", *sizes}))
        raise BundleError(f"{source}: {TRACE}: arrays missing or too many: {odd}")
    rows = arrays["time"].shape
    for name, values in arrays.items():
        kind, shape = (np.float64, rows) if name == "time" else (np.float32, (*rows, sizes[name]))
        if values.dtype != kind or values.shape != shape or not values.size or len(rows) != 1:
            raise BundleError(f"{source}: {TRACE}: {name}: {values.dtype} of shape {values.shape} instead of {shape}")
        if not np.isfinite(values).all():
            raise BundleError(f"{source}: {TRACE}: {name}: holds values that are not finite")
    return arrays

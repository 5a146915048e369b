# SPDX-License-Identifier: Apache-2.0
"""Forces of a skin in Foxglove and Rerun: in recordings, and live.

Both draw Protobuf messages of the schema foxglove.PointCloud, so a skin is two clouds of points:

=================  ===========================================================================
/skin/points       a point a cell: x y z, normal, force [N] and its standard deviation [N], colour
/skin/contacts     a point a contact: the same of the contact
=================  ===========================================================================

Rerun draws neither foxglove.Grid nor foxglove.SceneUpdate, so neither is written. Of a cloud it
draws the places and the colours, which Foxglove takes, too, unless told to colour by `force`.
"""

import time
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from foxglove.channels import PointCloudChannel
from foxglove.messages import (
    PackedElementField,
    PackedElementFieldNumericType,
    PointCloud,
    Pose,
    Quaternion,
    Timestamp,
    Vector3,
)
from mcap.reader import NonSeekingReader
from mcap.writer import Writer

import ohmskin
from ohmskin.arrays import FULL_SCALE_N, shades
from ohmskin.files import whole_file
from ohmskin.force.geometry import required
from ohmskin.force.tables import read_forces
from ohmskin.record.export import Part

__all__ = ["POINTS", "add_clouds", "clouds", "serve"]

POINTS, CONTACTS = "/skin/points", "/skin/contacts"
NAMES = ("x", "y", "z", "normal_x", "normal_y", "normal_z", "force", "force_std")
COLOUR = ("red", "green", "blue", "alpha")
# Forces are kept in steps of 1/1024 N, far below any deviation: digits of noise do not pack.
STEPS_A_NEWTON = 1024
# Red, green and blue of 0.1 N or less, of 1 N, and of 10 N or more: grey, yellow, red. Chosen: all
# are seen on a dark ground, and the scale is that of `ohmskin stream`.
_COLOURS = np.array([(90, 90, 90), (255, 220, 60), (220, 30, 30)])
_FIELDS = [
    PackedElementField(name=name, offset=4 * index, type=PackedElementFieldNumericType.Float32)
    for index, name in enumerate(NAMES)
] + [
    PackedElementField(
        name=name, offset=4 * len(NAMES) + index, type=PackedElementFieldNumericType.Uint8
    )
    for index, name in enumerate(COLOUR)
]
_STRIDE = 4 * len(NAMES) + len(COLOUR)
_HERE = Pose(position=Vector3(), orientation=Quaternion(w=1.0))


def clouds(scan: ohmskin.ForceScan) -> dict[str, PointCloud]:
    """The two clouds of a scan, by topic. Raises ValueError if the calibration has no geometry."""
    placed = required(scan.geometry)
    newtons = [scan.force_n[..., None], scan.force_n_std[..., None]]
    cells = np.concatenate([placed.position_m, placed.normal, *newtons], axis=-1)
    contacts = [[*c.position_m, *c.normal, c.force_n, c.force_n_std] for c in scan.contacts]
    return {
        topic: _cloud(np.array(points).reshape(-1, len(NAMES)), scan.time_ns, placed.frame_id)
        for topic, points in ((POINTS, cells), (CONTACTS, contacts))
    }


def _cloud(points: Any, time_ns: int, frame_id: str) -> PointCloud:
    points[:, -2:] = np.round(STEPS_A_NEWTON * points[:, -2:]) / STEPS_A_NEWTON
    shade = shades(points[:, -2], FULL_SCALE_N)
    colours = [np.interp(shade, (0, 0.5, 1), ramp) for ramp in _COLOURS.T]
    packed = np.full((len(points), _STRIDE), 255, np.uint8)
    packed[:, : 4 * len(NAMES)] = points.astype("<f4").view(np.uint8)
    packed[:, 4 * len(NAMES) : -1] = np.transpose(colours)
    return PointCloud(
        timestamp=Timestamp(sec=time_ns // 10**9, nsec=time_ns % 10**9),
        frame_id=frame_id,
        pose=_HERE,
        point_stride=_STRIDE,
        fields=_FIELDS,
        data=packed.tobytes(),
    )


def _messages(file: BinaryIO) -> Iterator[Any]:
    """Schemas, channels and messages of a recording, up to where it was cut off."""
    try:
        yield from NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False)
    except OSError:
        raise
    except Exception:  # half a record: each reader of records and chunks has errors of its own
        return


def add_clouds(recording: Path, calibration: ohmskin.Calibration, out: Path) -> int:
    """Write a recording with all its channels and the clouds of its forces. Returns its scans.

    `out` plays, exports and calibrates as the recording does. It is written whole or not at all. A
    recording whose recorder was killed is taken up to its last whole chunk.

    :raises FileExistsError: `out` is there already.
    :raises RecordingError: the recording cannot be read.
    :raises ValueError: the calibration is of another skin, or says no geometry; `out` cannot be
        written.
    """
    required(calibration.geometry)
    if out.exists():
        raise FileExistsError(f"{out}: is there already: say another file to write")
    part = Part(recording, timed=True)
    forces, schema = read_forces(part, calibration), PointCloud.get_schema()
    forces = chain([next(forces)], forces)  # what cannot be read is said before `out` is begun
    with recording.open("rb") as read, whole_file(out) as file:
        writer = Writer(file)
        writer.start(profile="", library="ohmskin")
        pointed = writer.register_schema(schema.name, schema.encoding, schema.data)
        of_topic = {
            topic: writer.register_channel(topic, "protobuf", pointed)
            for topic in (POINTS, CONTACTS)
        }
        channels: dict[int, int] = {}
        for kind, channel, message in _messages(read):
            if channel.topic in of_topic:  # of clouds that were added before
                continue
            if channel.id not in channels:
                form = writer.register_schema(kind.name, kind.encoding, kind.data) if kind else 0
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, form, channel.metadata
                )
            told = message.log_time, message.data, message.publish_time, message.sequence
            writer.add_message(channels[channel.id], *told)
            if channel.topic == "/skin/scan" and (scan := next(forces, None)) is not None:
                for topic, cloud in clouds(scan).items():
                    time_ns = scan.time_ns
                    writer.add_message(of_topic[topic], time_ns, cloud.encode(), time_ns)
        if next(forces, None) is not None:
            raise ohmskin.RecordingError(f"{recording}: damaged: the library mcap cannot read it")
        writer.finish()
    return part.scans


def serve(skin: ohmskin.LiveSkin, port: int = 8765, say: Callable[[str], object] = print) -> None:
    """Serve the clouds of a live skin to Foxglove, on loopback, until Ctrl-C.

    skin: of a calibration with a geometry; with ``every=False``, what is sent is always the newest.
    say: is given a line when clients may connect, and one whenever scans begin or cease to come.

    :raises RuntimeError: the port is taken.
    :raises PortError: the URL of the skin's port is wrong.
    :raises ValueError: the calibration is of another skin than that at the port.
    """
    import foxglove

    try:
        server = foxglove.start_server(name="ohmskin", host="127.0.0.1", port=port)
    except (RuntimeError, OverflowError) as exc:  # the latter: above 65535
        raise RuntimeError(f"port {port} is not free ({exc}): say another --ws-port") from exc
    channels = {topic: PointCloudChannel(topic) for topic in (POINTS, CONTACTS)}
    sent: ohmskin.ForceScan | None = None

    def send() -> None:
        """In the thread that reads: to wake another one would take time."""
        nonlocal sent
        scan = skin.newest()
        if scan is not None and scan is not sent:
            sent = scan
            for topic, cloud in clouds(scan).items():
                channels[topic].log(cloud, log_time=scan.time_ns)

    skin.watchers.add(send)
    try:
        say(f"Foxglove: open ws://localhost:{port}")
        said = ""
        while True:
            # Another calibration, or a wrong URL. (What may come yet is a PortUnusable.)
            if isinstance(skin.failure, ValueError) or type(skin.failure) is ohmskin.PortError:
                raise skin.failure
            if (state := skin.status) != said:
                say(said := state)
            time.sleep(0.2)
    except KeyboardInterrupt:
        pass
    finally:
        skin.watchers.discard(send)
        server.stop()

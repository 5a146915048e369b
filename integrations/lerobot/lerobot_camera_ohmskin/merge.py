# SPDX-License-Identifier: Apache-2.0
"""``ohmskin-lerobot``: a recording made beside episodes becomes a feature of their dataset.

The recording has a mark that begins with the word "episode" at the first frame of each episode, in
the order of the dataset: type it while `ohmskin record` runs, or add it by a program.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ohmskin
from lerobot_camera_ohmskin.robot import SCANS


def windows(
    arrays: dict[str, NDArray[Any]], episode: NDArray[Any], timestamp_s: NDArray[Any]
) -> tuple[NDArray[np.float32], NDArray[np.float32], int]:
    """Forces (frames, `SCANS`, R, C) [N] and scan numbers (frames, `SCANS`) of a dataset's frames.

    A frame has the scans since the frame before it, the oldest first, then zeros and -1. If they
    are more than `SCANS`, it has the newest, and the others are counted: how many found no place.

    arrays: of `ohmskin.load_forces`. episode, timestamp_s: of each frame, as datasets have them.

    :raises ValueError: there are not as many marks as episodes.
    """
    is_begin = np.char.startswith(arrays["mark_text"].astype(str), "episode")
    begins_ns = arrays["mark_time_ns"][is_begin]
    if begins_ns.size != len(set(episode.tolist())):
        marks = f"{begins_ns.size} marks that begin with 'episode'"
        raise ValueError(f"{marks}, the dataset has {len(set(episode.tolist()))} episodes")
    order = np.unique(episode, return_inverse=True)[1]
    ends_ns = begins_ns[order] + np.round(1e9 * timestamp_s).astype(np.int64)
    # The first frame of an episode has what came in the time of a frame before it.
    first = np.flatnonzero(np.diff(order, prepend=-1))
    frame_ns = int(np.median(np.diff(ends_ns))) if ends_ns.size > 1 else 0
    starts_ns = np.concatenate([ends_ns[:1], ends_ns[:-1]])
    starts_ns[first] = ends_ns[first] - frame_ns
    ends = np.searchsorted(arrays["time_ns"], ends_ns, side="right")
    of_frame = np.searchsorted(arrays["time_ns"], starts_ns, side="right")
    starts = np.maximum(of_frame, ends - SCANS)
    force_n = np.zeros((ends.size, SCANS, *arrays["force_n"].shape[1:]), np.float32)
    numbers = np.full((ends.size, SCANS), -1, np.float32)
    for frame, (begin, end) in enumerate(zip(starts, ends, strict=True)):
        force_n[frame, : end - begin] = np.nan_to_num(arrays["force_n"][begin:end])
        numbers[frame, : end - begin] = arrays["number"][begin:end]
    return force_n, numbers, int((starts - of_frame).sum())


def merge(root: Path, recording: Path, calibration: str, name: str, out: Path) -> int:
    """Write the dataset at `root` to `out`, with the features NAME.force and NAME.number.

    Returns how many scans found no place (`windows`).
    """
    from lerobot.datasets.dataset_tools import add_features
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset(root.name, root=root)
    frames = dataset.hf_dataset.with_format("numpy")
    arrays = ohmskin.load_forces(recording, ohmskin.load_calibration(calibration))
    episode, time_s = (np.asarray(frames[key][:]) for key in ("episode_index", "timestamp"))
    *told, lost = windows(arrays, episode, time_s)
    features = {
        f"observation.{name}.{kind}": (
            values,
            {"dtype": "float32", "shape": list(values.shape[1:]), "names": None},
        )
        for kind, values in zip(("force", "number"), told, strict=True)
    }
    add_features(dataset, features, output_dir=out, repo_id=out.name)
    return lost


def main() -> None:
    """The command line. An error is one line, exit code 1."""
    parser = argparse.ArgumentParser(prog="ohmskin-lerobot", description=__doc__)
    parser.add_argument("command", choices=["merge"])
    parser.add_argument("dataset", type=Path, help="folder of a LeRobotDataset")
    parser.add_argument("recording", type=Path, help="made beside it (.mcap)")
    parser.add_argument("calibration")
    parser.add_argument("out", type=Path, help="folder to write, a new one")
    parser.add_argument("--name", default="skin", help="observation.NAME.force")
    told = parser.parse_args()
    try:
        lost = merge(told.dataset, told.recording, told.calibration, told.name, told.out)
        print(f"{told.out}: {lost} scans found no place, as a frame has places for {SCANS}")
    except (ohmskin.OhmskinError, ValueError, OSError) as exc:
        raise SystemExit(f"ohmskin-lerobot: {exc}") from exc


if __name__ == "__main__":
    main()

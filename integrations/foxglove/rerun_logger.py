# SPDX-License-Identifier: Apache-2.0
"""Log a live skin to Rerun: python rerun_logger.py PORT CALIBRATION [OUT.rrd]

Without OUT, the viewer opens. A board that is unplugged and plugged again goes on; Ctrl-C ends it.
(A recording with clouds, by ohmskin-foxglove add, opens in Rerun too.)
"""

import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import rerun as rr

import ohmskin
from ohmskin.files import check_place
from ohmskin.force.geometry import required

if len(sys.argv) not in (3, 4):
    sys.exit(__doc__)
port, path, *out = sys.argv[1:]
try:
    calibration = ohmskin.load_calibration(path)
    points = required(calibration.geometry).position_m.reshape(-1, 3)
    for each in out:
        check_place(Path(each), ending=".rrd")
except ValueError as exc:
    sys.exit(f"rerun_logger: {exc}")
rr.init("ohmskin")
if out:
    rr.save(out[0])
else:  # rr.spawn would let other computers reach the viewer
    subprocess.Popen([sys.executable, "-m", "rerun", "--bind", "127.0.0.1"], start_new_session=True)
    rr.connect_grpc()
count = logged = missed = 0
said = ""
with suppress(KeyboardInterrupt), ohmskin.LiveSkin(port, calibration) as skin:
    over = False
    while not over:
        over = skin.ended or isinstance(skin.failure, ValueError)  # then `since` gives the last
        if (state := skin.status) != said:
            print(said := state, flush=True)
        count, scans = skin.since(count, timeout_s=1.0)
        for scan in scans:
            missed += scan.missed
            rr.set_time("time", timestamp=np.datetime64(scan.time_ns, "ns"))
            radii = 0.001 + 0.0005 * np.nan_to_num(scan.force_n).ravel()
            rr.log("skin/points", rr.Points3D(points, radii=radii))
            forces = scan.force_n.astype(np.float32)
            rr.log("skin/force", rr.Tensor(forces, dim_names=("row", "column")))
            for contact in scan.contacts:
                rr.log(f"skin/contact/{contact.identity}", rr.Scalars(contact.force_n))
            logged += 1
late = skin.skipped + skin.since(count)[0] - logged
skipped = f"{late} skipped by a busy machine or at the end"
print(f"{logged} scans logged; {missed} missed on the line; {skipped}")
if isinstance(skin.failure, ValueError):  # such as a calibration of another skin
    sys.exit(f"rerun_logger: {skin.failure}")

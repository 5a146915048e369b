# SPDX-License-Identifier: Apache-2.0
"""Log a live skin to Rerun: python rerun_logger.py PORT CALIBRATION [OUT.rrd]

Without OUT, the viewer opens. A board that is unplugged and plugged again goes on; Ctrl-C ends it.
(A recording with clouds, by ohmskin-foxglove add, opens in Rerun too.)
"""

import sys

import numpy as np
import rerun as rr

import ohmskin

port, calibration, *out = sys.argv[1:]
rr.init("ohmskin", spawn=not out)
if out:
    rr.save(out[0])
with ohmskin.LiveSkin(port, calibration) as skin:
    count = 0
    while not skin.ended:
        count, scans = skin.since(count, timeout_s=1.0)
        for scan in scans:
            rr.set_time("time", timestamp=np.datetime64(scan.time_ns, "ns"))
            points = scan.geometry.position_m.reshape(-1, 3)
            radii = 0.001 + 0.0005 * np.nan_to_num(scan.force_n).ravel()
            rr.log("skin/points", rr.Points3D(points, radii=radii))
            forces = scan.force_n.astype(np.float32)
            rr.log("skin/force", rr.Tensor(forces, dim_names=("row", "column")))
            for contact in scan.contacts:
                rr.log(f"skin/contact/{contact.identity}", rr.Scalars(contact.force_n))

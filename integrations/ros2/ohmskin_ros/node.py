# SPDX-License-Identifier: Apache-2.0
"""The node of a skin.

~/points      sensor_msgs/PointCloud2          x y z normal_x normal_y normal_z force force_std
~/image       sensor_msgs/Image                forces [N], one pixel a cell, 32FC1
/diagnostics  diagnostic_msgs/DiagnosticArray  once a second: whether scans come, and what was lost
~/tare        std_srvs/Trigger                 what the skin reads now is no force
~/examine     std_srvs/Trigger                 what 'ohmskin doctor' says of the board: up to 10 s

Parameters: port, calibration (with a geometry), frame_id ("": that of the geometry), every (false:
publish the newest scan alone, where a machine is too busy for all of them).

Points and images are reliable with a depth of 100: a second of scans. RViz subscribes so, and a
subscriber that asks for best effort gets them as well.
"""

import threading
from contextlib import suppress
from operator import sub

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image, PointCloud2
from std_srvs.srv import Trigger

import ohmskin
from ohmskin.cli.doctor_words import verdict, words_of
from ohmskin.doctor.examine import examine
from ohmskin.doctor.gather import gather
from ohmskin.files import naming
from ohmskin.force.geometry import required
from ohmskin_ros.messages import header, image, point_cloud, stamp_off_s

# Diagnostics warn where more than this share of the last second's scans was not published. Chosen:
# a pause of a busy machine now and then is no fault.
SKIPPED_SHARE = 0.1
# They warn, too, where stamps are so far from the clock of the day [s]. Chosen: no line delays a
# scan for so long, and what other nodes saw at the same moment is no longer found by its stamp.
STAMP_OFF_S = 0.5
QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)


class SkinNode(Node):
    """Publishes every scan of one skin, through all that is unplugged."""

    def __init__(self) -> None:
        super().__init__("ohmskin")
        port = self.declare_parameter("port", "/dev/ttyACM0").value
        path = self.declare_parameter("calibration", "skin.json").value
        frame_id = self.declare_parameter("frame_id", "").value
        every = self.declare_parameter("every", True).value
        calibration = ohmskin.load_calibration(path)
        with naming(path):
            self._frame_id = frame_id or required(calibration.geometry).frame_id
        self._points = self.create_publisher(PointCloud2, "~/points", QOS)
        self._image = self.create_publisher(Image, "~/image", QOS)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # They take seconds, in which diagnostics go on; one at a time, as each needs the board.
        slow = MutuallyExclusiveCallbackGroup()
        self.create_service(Trigger, "~/tare", self._tare, callback_group=slow)
        self.create_service(Trigger, "~/examine", self._examine, callback_group=slow)
        self.create_timer(1.0, self._diagnose)
        self.missed = self.published = 0
        self._before = 0, 0  # published and skipped, at the last diagnosis
        self._state = ""  # what the terminal was told last
        self._doctor: DiagnosticStatus | None = None  # what it has said last
        self.skin = ohmskin.LiveSkin(port, calibration, every=every)
        # A thread, so that a tare, which takes a second, holds up no scan.
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def _publish(self) -> None:
        for scan in self.skin:
            head = header(scan, self._frame_id)
            try:
                self._points.publish(point_cloud(scan, head))
                self._image.publish(image(scan, head))
            except Exception:
                if rclpy.ok():
                    raise
                return  # Ctrl-C ends the context, which all publishers need, before this thread
            self.missed += scan.missed
            self.published += 1

    def _tare(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        try:
            self.skin.tare()
            answer.success, answer.message = True, "tared"
        except (ohmskin.OhmskinError, ValueError) as exc:
            answer.success, answer.message = False, str(exc)
        return answer

    def _examine(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Ask the doctor, whose word is part of the diagnostics from then on."""
        try:
            device, _reader = self.skin.there()
            diagnosis = examine(gather(device))
            device.start()  # it stands still after that
        except (ohmskin.OhmskinError, ValueError) as exc:
            answer.success, answer.message = False, str(exc)
            return answer
        answer.success, answer.message = diagnosis.sound, verdict(diagnosis)
        told = [(each.kind.id, words_of(each)) for each in diagnosis.findings]
        values = [
            KeyValue(key=f"{kind}: {of['where']}", value=of["what_to_do"]) for kind, of in told
        ]
        level = DiagnosticStatus.OK if diagnosis.sound else DiagnosticStatus.WARN
        name, said, port = f"{self.get_name()}: doctor", answer.message, self.skin.port
        self._doctor = DiagnosticStatus(
            level=level, name=name, message=said, hardware_id=port, values=values
        )
        return answer

    def _diagnose(self) -> None:
        failure: Exception | str | None = self.skin.failure
        newest = self.skin.newest()
        if failure is None and not self._thread.is_alive():
            failure = "nothing is published any more (the terminal says why): start the node again"
        state = str(failure or self.skin.status)
        level, said = DiagnosticStatus.OK, "scanning"
        if failure is not None or newest is None:
            level, said = DiagnosticStatus.ERROR, state
        elif newest.estimate.message:
            level, said = DiagnosticStatus.WARN, newest.estimate.message
        elif abs(off_s := stamp_off_s(newest)) > STAMP_OFF_S:
            what = f"stamps and the clock of this machine are {abs(off_s):.1f} s apart"
            why = "it was set after the port was opened (start the node again)"
            level, said = DiagnosticStatus.WARN, f"{what}: {why}, or the port is a recording"
        if state != self._state and failure is None:
            self.get_logger().info(state)
        elif state != self._state:
            self.get_logger().error(state)
        self._state = state
        now = self.published, self.skin.skipped
        published, skipped = map(sub, now, self._before)
        self._before = now
        if level == DiagnosticStatus.OK and skipped > SKIPPED_SHARE * (published + skipped):
            what = f"{skipped} of the last {published + skipped} scans were skipped"
            level, said = DiagnosticStatus.WARN, f"{what}: this machine is too slow for all"
        counts = {
            "scans": self.published,
            "missed on the line": self.missed,
            "skipped, as this machine is too slow": self.skin.skipped,
            "times the port was opened": self.skin.opened,
        }
        values = [KeyValue(key=key, value=str(count)) for key, count in counts.items()]
        name, port = self.get_name(), self.skin.port
        status = DiagnosticStatus(
            level=level, name=name, message=said, hardware_id=port, values=values
        )
        array = DiagnosticArray(status=[status, *filter(None, [self._doctor])])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def close(self) -> None:
        """End reading and publishing."""
        self.skin.close()
        self._thread.join()
        self.destroy_node()


def main() -> None:
    """Run the node until Ctrl-C."""
    rclpy.init()
    try:
        node = SkinNode()
    except (ValueError, ohmskin.OhmskinError, ParameterException) as exc:
        rclpy.try_shutdown()
        raise SystemExit(f"ohmskin_ros: {exc}") from exc
    try:
        with suppress(KeyboardInterrupt, ExternalShutdownException):
            rclpy.spin(node, MultiThreadedExecutor(num_threads=2))
    finally:
        node.close()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()

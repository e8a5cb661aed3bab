#!/usr/bin/python3
"""A camera: publishes a moving picture and its calibration. dynamic_reconfigure sets `rate` and `brightness`."""

import diagnostic_updater
import dynamic_reconfigure.server
import rospy
from sensor_msgs.msg import CameraInfo, Image
from sensor_msgs.srv import SetCameraInfo, SetCameraInfoResponse

WIDTH, HEIGHT = 64, 48


class Config:
    """The type that dynamic_reconfigure would generate from a .cfg file if Debian had catkin."""

    defaults = {"rate": 10.0, "brightness": 128, "mirrored": False}
    min = {"rate": 1.0, "brightness": 0, "mirrored": False}
    max = {"rate": 30.0, "brightness": 255, "mirrored": True}
    config_description = {
        "name": "Default", "id": 0, "parent": 0, "type": "", "state": True, "groups": [],
        "parameters": [
            {"name": name, "type": kind, "level": 0, "description": text, "edit_method": ""}
            for name, kind, text in [
                ("rate", "double", "images a second"),
                ("brightness", "int", "0 to 255"),
                ("mirrored", "bool", "left is right"),
            ]
        ],
    }


def main():
    rospy.init_node("camera")
    current = {}

    def changed(config, _level):
        current.update(config)
        return config

    images = rospy.Publisher("image_raw", Image, queue_size=100)
    calibrations = rospy.Publisher("camera_info", CameraInfo, queue_size=10)
    calibration = CameraInfo(width=WIDTH, height=HEIGHT, distortion_model="plumb_bob")

    def calibrate(request):
        calibration.K, calibration.D = request.camera_info.K, request.camera_info.D
        return SetCameraInfoResponse(True, "")

    rospy.Service("set_camera_info", SetCameraInfo, calibrate)
    dynamic_reconfigure.server.Server(Config, changed)
    updater = diagnostic_updater.Updater()
    updater.setHardwareID(rospy.get_param("~serial"))
    updater.add("camera: images", lambda status: (status.summary(status.OK, "streaming"), status)[1])

    image = Image(width=WIDTH, height=HEIGHT, step=3 * WIDTH, encoding="rgb8")
    image.header.frame_id = calibration.header.frame_id = rospy.get_param("~frame")
    shift = 0
    while not rospy.is_shutdown():
        shift = (shift + (-1 if current["mirrored"] else 1)) % WIDTH
        row = bytes((column + shift) * 4 % 256 * current["brightness"] // 255
                    for column in range(WIDTH) for _ in range(3))
        image.data = row * HEIGHT
        image.header.stamp = calibration.header.stamp = rospy.Time.now()
        images.publish(image)
        calibrations.publish(calibration)
        updater.update()
        rospy.sleep(1 / current["rate"])


if __name__ == "__main__":
    try:
        main()
    except rospy.ROSInterruptException:
        pass

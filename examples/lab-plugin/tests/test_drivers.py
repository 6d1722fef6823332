"""Stage and camera keep the rules that SlipLab holds drivers to, on their fakes."""

import lab_camera
import lab_stage

from sliplab.testing import conformance, free_port

STAGE = lab_stage.LabStageSettings(
    host="127.0.0.1",
    port=free_port(),
    limits={"low_mm": (300, -100, 200), "high_mm": (500, 100, 400)},
)
test_stage = conformance(lab_stage.DRIVER, STAGE)
test_camera = conformance(lab_camera.DRIVER, lab_camera.LabCameraSettings(stall_s=0.4))

"""Assembly of a loopback rig, as a rig file with `driver: loopback` describes it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial

from sliplab.plugins.loopback.client import Loopback
from sliplab.plugins.simulation.settings import scene_of
from sliplab.rigs.build import ShouldStop, driven_rig, never
from sliplab.rigs.core.driver import BuildRig
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.rig_file import RigFile


def build_rig(file: RigFile, should_stop: ShouldStop) -> Rig:
    """Build a rig of real drivers; fakes in a separate process show the simulated scene.

    Raises:
        RigError: the fakes do not start, or cannot be reached.
    """
    assert file.devices is not None
    with ExitStack() as undo:
        stage = Loopback(scene_of(file), file.timing, file.devices, file.streams)
        undo.callback(stage.close)
        rig = loopback_rig(file, stage, should_stop, (stage.close,))
        undo.pop_all()
    return rig


@contextmanager
def rig_builder(file: RigFile) -> Iterator[BuildRig]:
    """Yield what builds rigs one after the other on the same fakes.

    Raises:
        RigError: the fakes do not start.
    """
    assert file.devices is not None
    stage = Loopback(scene_of(file), file.timing, file.devices, file.streams)
    with closing(stage):
        yield lambda rig, should_stop: loopback_rig(rig, stage, should_stop)


def loopback_rig(
    file: RigFile,
    stage: Loopback,
    should_stop: ShouldStop = never,
    on_close: tuple[Callable[[], None], ...] = (),
) -> Rig:
    """Build a rig of real drivers on running fakes, which stay the caller's to close.

    Args:
        file: a `loopback` rig file with the arm and the scene that `stage` simulates.
        on_close: called last when the rig is closed.

    Raises:
        RigError: a fake cannot be reached.
    """
    reached = stage.reached_by(file)
    assert reached.devices is not None
    driver, camera = reached.devices.frame_camera_driver, reached.devices.frame_camera
    assert driver.fake is not None  # the rig file was held against it
    scale, half_ns = (
        file.frame_camera.scale_px_per_mm,
        scene_of(file).frame_camera.exposure_us * 500,
    )
    frames = partial(driver.fake, camera, scale, stage, half_ns)
    return driven_rig(reached, stage, stage, should_stop, stage, frames, on_close)

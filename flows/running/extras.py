"""The extra of SlipLab that installs a missing package."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

EXTRAS = {
    "hardware": (
        "rtde_control",
        "rtde_receive",
        "abb_motion_program_exec",
        "abb_robot_client",
        "requests",
        "serial",
        "pypylon",
        "dv_processing",
    ),
    "video": ("av", "cv2"),
    "parquet": ("pyarrow",),
    "learn": ("torch", "sinabs", "sklearn", "threadpoolctl"),
    "prefect": ("prefect", "starlette", "uvicorn"),
    "report": ("matplotlib", "jinja2"),
    "alerts": ("apprise",),
    "cluster": ("distributed", "prefect_dask"),
    "view": ("rerun",),
    "onnx": ("onnx", "onnxruntime"),
    "publish": ("mcap", "zstandard", "lz4"),
    "formats": ("faery", "rosbags"),
    "lsl": ("pylsl",),
    "xarray": ("xarray",),
}
"""Modules that each extra installs."""

_BRINGS = {module: extra for extra, modules in EXTRAS.items() for module in modules}


def lacking(error: BaseException, who: str) -> str | None:
    """Say in one line which extra `who` needs, if `error` is that its package is missing."""
    # an installed package that lacks one of its modules is damaged, and no extra mends it
    module = error.name if isinstance(error, ModuleNotFoundError) else None
    extra = _BRINGS.get(module or "")
    if extra is None:
        return None
    return f"`{who}` needs {module}, from the extra '{extra}': pip install 'sliplab[{extra}]'"


@contextmanager
def named(who: str) -> Iterator[None]:
    """Name the extra where a package of one is missing inside.

    Raises:
        ModuleNotFoundError: as it was raised, with the extra in its message.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if stated := lacking(error, who):
            raise ModuleNotFoundError(stated, name=error.name) from error
        raise

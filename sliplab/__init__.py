"""SlipLab: run tactile slip experiments, from a protocol file to a report.

    import sliplab

    plan = sliplab.plan("pilot")
    store = sliplab.collect("pilot", rig="rehearsal", store="data", trials=2)
    store.label()
    trial = next(iter(store))
    events = trial.events()
    print(trial.onsets(), len(events), events.t_ns[0])

Importing this loads nothing and starts nothing; each name is loaded when it is first used.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

# Python that starts in the root of a checkout finds this folder before the installed links to it.
__path__ += [
    str(links) for links in [Path(__file__).parents[1] / ".links" / "sliplab"] if links.is_dir()
]

from sliplab.moved import install as _install  # noqa: E402

_install()

if TYPE_CHECKING:
    from sliplab.flows.api import (
        Events,
        Model,
        Onsets,
        Poses,
        Scalars,
        Store,
        Trial,
        WindowCounts,
        check,
        collect,
        export,
        import_data,
        load_model,
        open_store,
        plan,
        verify,
    )
    from sliplab.flows.collecting.requests import CampaignStopped
    from sliplab.plugins.align.align import Alignment, AlignmentRefused, align
    from sliplab.plugins.align.taps import align_taps
    from sliplab.plugins.record.recorder import record
    from sliplab.plugins.record.sources import columns, lsl, push, usb_camera
    from sliplab.protocols.errors import InputError
    from sliplab.protocols.plan import Plan
    from sliplab.storage.errors import StoreError

__all__ = [
    "Alignment",
    "AlignmentRefused",
    "CampaignStopped",
    "Events",
    "InputError",
    "Model",
    "Onsets",
    "Plan",
    "Poses",
    "Scalars",
    "Store",
    "StoreError",
    "Trial",
    "WindowCounts",
    "__version__",
    "align",
    "align_taps",
    "check",
    "collect",
    "columns",
    "export",
    "import_data",
    "load_model",
    "lsl",
    "open_store",
    "plan",
    "push",
    "record",
    "usb_camera",
    "verify",
]
__version__: str

_ELSEWHERE = {
    "columns": "sliplab.plugins.record.sources",
    "lsl": "sliplab.plugins.record.sources",
    "push": "sliplab.plugins.record.sources",
    "record": "sliplab.plugins.record.recorder",
    "usb_camera": "sliplab.plugins.record.sources",
    "Alignment": "sliplab.plugins.align.align",
    "AlignmentRefused": "sliplab.plugins.align.align",
    "CampaignStopped": "sliplab.flows.collecting.requests",
    "InputError": "sliplab.protocols.errors",
    "Plan": "sliplab.protocols.plan",
    "StoreError": "sliplab.storage.errors",
    "align": "sliplab.plugins.align.align",
    "align_taps": "sliplab.plugins.align.taps",
}


def __getattr__(name: str) -> Any:
    from importlib import import_module, metadata

    if name == "__version__":
        return metadata.version("sliplab")
    if name not in __all__:
        raise AttributeError(f"module 'sliplab' has no attribute '{name}'")
    return getattr(import_module(_ELSEWHERE.get(name, "sliplab.flows.api")), name)


def __dir__() -> list[str]:
    return sorted(__all__)

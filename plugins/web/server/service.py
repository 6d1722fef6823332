"""Settings of `sliplab serve`, passed to the processes of its flow runs.

They are passed by the environment and not by the runs' parameters, which anyone who sees
Prefect's page could change.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

from sliplab.protocols import InputError
from sliplab.protocols.yaml_file import parse_yaml, read_text

ENVIRONMENT = "SLIPLAB_SERVICE"
SUFFIXES = (".yaml", ".yml")


@dataclass(frozen=True)
class Service:
    """One rig, one store, one program that serves them.

    Attributes:
        store: its absolute folder; rig: a rig file, or the name of one that ships.
        name: of the service, in those of its deployments: ``collect/collect NAME``.
        server: Prefect's, as `run_records.server_name` calls it.
        pid: of the program that serves.
        protocols: folders below which a run may name its protocol, and files that a schedule names;
            a relative name is of the first.
        urls: of remote stores that schedules name.
        since: number of the last control request when a run's process was started; of that alone.
    """

    store: str
    rig: str
    name: str
    server: str
    pid: int
    protocols: tuple[str, ...]
    urls: tuple[str, ...] = ()
    since: int | None = None

    @property
    def folder(self) -> Path:
        """The store's folder."""
        return Path(self.store)

    def export_environment(self) -> None:
        """Export it to the environment of processes that are started from here on."""
        os.environ.update(self.environment())

    def environment(self) -> dict[str, str]:
        """Return it as a variable of the environment."""
        return {ENVIRONMENT: json.dumps(asdict(self))}

    def protocol(self, given: Path) -> Path:
        """Return the protocol file that a run's parameter names.

        The user who names it may have fewer rights than the service: a file that is not below the
        service's folders is ignored, and no content of a file that is not a protocol is quoted.

        Raises:
            InputError: it is elsewhere, links followed, or is not a protocol.
        """
        found = (Path(self.protocols[0]) / given).resolve()
        roots = [Path(root) for root in self.protocols]
        if not any(found == root or root in found.parents for root in roots) or (
            found.suffix.lower() not in SUFFIXES
        ):
            below = ", ".join(self.protocols)
            raise InputError(
                "protocol", "", str(given), f"must be a file {' or '.join(SUFFIXES)} below {below}"
            )
        text = read_text(found, "protocol")
        try:
            known = "protocol" in parse_yaml(text, found)
        except InputError:
            known = False
        if not known:
            raise InputError(found, "", None, "is not a valid protocol; `sliplab plan` shows why")
        return found

    def url(self, given: str) -> str:
        """Return the URL that a run's parameter names; data are sent nowhere else.

        Raises:
            InputError: no schedule names it.
        """
        if given in self.urls:
            return given
        if not given and self.urls:
            return self.urls[0]
        known = ", ".join(self.urls) or "none: give a schedule of the flow push its url"
        raise InputError("url", "", given, f"must be one that the schedules name ({known})")


def service() -> Service:
    """Return the settings of the service that started this process.

    Raises:
        RuntimeError: no service is running.
    """
    text = os.environ.get(ENVIRONMENT)
    if text is None:
        raise RuntimeError("this flow runs only under `sliplab serve`")
    given = json.loads(text)
    lists = {name: tuple(given[name]) for name in ("protocols", "urls")}
    return Service(**{**given, **lists})


def deployment_name(flow: str, name: str) -> str:
    """Return the name of a flow's deployment, which begins with what it does: ``stop NAME``."""
    return f"{flow} {name}"

"""The embedded server's SQLite file, begun as a copy of one that has its tables already.

Prefect makes the tables of a new file by all migrations since its first version, which takes half
of the server's start. So the first file that is made with a version of Prefect is copied, empty as
it is then, into the user's cache folder, and every later store begins with that copy. It may be
deleted at any time; one that is damaged is left aside.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from contextlib import closing, suppress
from pathlib import Path

NAME = "prefect.db"
_CONNECTION = ("PREFECT_SERVER_DATABASE_CONNECTION_URL", "PREFECT_API_DATABASE_CONNECTION_URL")
_MADE = "alembic_version"
"""The one table with a row in a file that has just been made."""


def ready(home: Path) -> None:
    """Have the tables in Prefect's home; does nothing where the user has set another database."""
    if any(name in os.environ for name in _CONNECTION) or (home / NAME).exists():
        return
    template = _template()
    if template is not None and _sound(template):
        _copy(template, home / NAME)
        return
    _make()
    if template is not None:
        with suppress(OSError, sqlite3.Error):  # a folder that cannot be written to
            _keep(home / NAME, template)


def _template() -> Path | None:
    """Where the file to begin with is kept; None for a user without a home."""
    import prefect

    try:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:
        return None
    return base / "sliplab" / f"prefect-{prefect.__version__}.db"


def _sound(path: Path) -> bool:
    """Whether it is a file with tables, and nothing in them but which tables they are."""
    if not path.is_file():
        return False
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as file:
            if file.execute("pragma quick_check").fetchone() != ("ok",):
                return False
            tables = {
                name
                for (name,) in file.execute("select name from sqlite_master where type='table'")
            }
            return (
                {_MADE, "flow_run", "task_run"} <= tables
                and file.execute(f"select count(*) from {_MADE}").fetchone() == (1,)
                and file.execute("select count(*) from flow_run").fetchone() == (0,)
            )
    except sqlite3.Error:
        return False


def _make() -> None:
    """Let Prefect make its tables where its settings say."""
    import asyncio

    from prefect.server.database import provide_database_interface

    asyncio.run(provide_database_interface().create_db())


def _keep(made: Path, template: Path) -> None:
    template.parent.mkdir(parents=True, exist_ok=True)
    aside = template.with_name(f".{template.name}.{os.getpid()}.tmp")
    try:
        with closing(sqlite3.connect(made)) as source, closing(sqlite3.connect(aside)) as target:
            source.backup(target)
        os.replace(aside, template)
    finally:
        aside.unlink(missing_ok=True)


def _copy(template: Path, target: Path) -> None:
    aside = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        shutil.copyfile(template, aside)
        os.replace(aside, target)
    finally:
        aside.unlink(missing_ok=True)

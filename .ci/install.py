"""Install this checkout, editable: `python .ci/install.py EXTRAS`, with the Python to install into.

By uv, which takes a tenth of pip's time. It does not read pip's settings, so those of where
packages come from are given to it. pip does the work where uv cannot be had, or fails.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys

PIP = [sys.executable, "-m", "pip"]
QUIET = ["install", "--quiet"]
PASSED_ON = ("index-url", "extra-index-url", "find-links", "constraint")


def main(extras: str) -> int:
    """Return the exit code of the installer."""
    wanted = ["-c", "constraints.txt", "-e", f".[{extras}]"]
    own = [*PIP, *QUIET, "--disable-pip-version-check", "--no-compile"]  # Python compiles at import
    if subprocess.run([*own, "uv"]).returncode == 0:
        settings = pip_settings()
        places = [(name, place) for name in PASSED_ON for place in settings.get(name, "").split()]
        options = [f"--{name}={place}" for name, place in places]
        uv = [sys.executable, "-m", "uv", "pip", *QUIET, f"--python={sys.executable}"]
        uv += ["--index-strategy=unsafe-best-match", *options]  # pip's: the best of all indexes
        certificates = {"SSL_CERT_FILE": settings["cert"]} if "cert" in settings else {}
        if subprocess.run([*uv, *wanted], env={**certificates, **os.environ}).returncode == 0:
            return 0
    return subprocess.run([*own, *wanted]).returncode


def pip_settings() -> dict[str, str]:
    """Return pip's settings, without their sections; those of the environment count more."""
    listed = subprocess.run([*PIP, "config", "list"], capture_output=True, text=True, check=True)
    found: dict[str, str] = {}
    for line in listed.stdout.splitlines():  # the environment's come first
        section, _, setting = line.partition(".")
        name, _, value = setting.partition("=")
        if section in (":env:", "global", "install"):
            found.setdefault(name, ast.literal_eval(value))
    return found


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))

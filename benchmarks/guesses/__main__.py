"""`python -m benchmarks.guesses STORE`."""

from benchmarks.command import run_command
from benchmarks.guesses.study import STUDY
from sliplab.flows.cli.study_command import study_app

run_command(study_app(STUDY))

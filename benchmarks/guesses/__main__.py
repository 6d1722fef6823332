"""`python -m benchmarks.guesses STORE`."""

from benchmarks.guesses.study import STUDY
from sliplab.flows.cli.study_command import study_app

study_app(STUDY)()

"""Small probabilities of completing are exact, and the bound of their error holds."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from petrobot.coordinator.analysis.time.measured import Measured
from petrobot.coordinator.analysis.time.stochastic import stochastic_view
from petrobot.coordinator.analysis.time.task_forecast import Forecast, forecast
from petrobot.coordinator.task import Estimate, Status
from petrobot.coordinator.task.file import loads


def steps(n: int, success: float, again: float = 0.0) -> Forecast:
    """A series of n steps; each succeeds with this probability, is repeated with `again`, or ends
    the task without completing it."""
    text = (
        'schema = 1\n[task]\nname = "steps"\nfinal = "over == 1"\n'
        '[places.jobs]\nkind = "control"\ntokens = 1\n[places.over]\nkind = "control"\n'
        '[places.gone]\nkind = "control"\n[transitions.begin]\nin = ["jobs"]\nout = ["s0"]\n'
    )
    measured = {}
    for k in range(n):
        after = "over" if k == n - 1 else f"s{k + 1}"
        text += (
            f'[primitive_tasks.s{k}]\ngoal = "g"\nalternatives = ["s{k}_a"]\ndeadline = 9.0\n'
            f'[places.s{k}]\nkind = "action"\ntask = "s{k}"\n'
            f'[transitions.s{k}_on]\nin = ["s{k}:normal"]\nout = ["{after}"]\n'
            f"when = \"s{k}.status == 'success'\"\n"
            f'[transitions.s{k}_again]\nin = ["s{k}:normal"]\nout = ["s{k}"]\n'
            f"when = \"s{k}.status == 'failure'\"\n"
            f'[transitions.s{k}_lost]\nin = ["s{k}:error"]\nout = ["gone"]\n'
        )
        measured[f"s{k}", f"s{k}_a"] = {
            status: Estimate(share, 1.0)
            for status, share in (
                (Status.SUCCESS, success),
                (Status.FAILURE, again),
                (Status.ERROR, 1.0 - success - again),
            )
            if share > 0
        }
    view = stochastic_view(loads(text, "steps.toml"), Measured(measured), stages=1)
    return forecast(view)


@pytest.mark.parametrize(
    ("n", "success", "again"), [(6, 0.1, 0.0), (6, 0.05, 0.5), (12, 1e-3, 0.2)]
)
def test_small_probabilities_of_completing_are_exact(n: int, success: float, again: float) -> None:
    """Down to 1e-35 to ten digits, as (success / (1 - again))^n; the bound contains the error."""
    found = steps(n, success, again)
    truth = (success / (1.0 - again)) ** n
    assert found.completion_probability == pytest.approx(truth, rel=1e-10, abs=0.0)
    off = abs(found.completion_probability / truth - 1.0)
    assert off <= found.completion_error
    assert 0.0 < found.completion_error < 1e-10
    assert found.to_json(())["P_complete_error"] == found.completion_error


def test_a_wrong_solution_is_noticed() -> None:
    """The bound comes from the residual, not from the solver: it grows with the error."""
    found = steps(6, 0.1, 0.3)
    right = found.completion_probability
    wrong = found.done.h * (1.0 + 1e-4 * np.random.default_rng(1).random(len(found.done.h)))
    wrong[found.done.goal] = 1.0
    other = replace(found, done=replace(found.done, h=wrong))
    off = abs(other.completion_probability / right - 1.0)
    assert 0.0 < off <= other.completion_error < 0.01

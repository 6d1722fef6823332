"""Runs that wait for their turn or time: which may still begin, and which are no longer expected.

A run that waited moves the arm by itself, when the one before it ends or the service comes back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any
from uuid import UUID

from sliplab.flows.collecting.requests import MOVING
from sliplab.flows.running import console
from sliplab.plugins.web.server.schedules import Scheduled, begin_of_run

AGAIN = "by schedule"
"""Tag of a late run that was made again."""
PAGE = 200
"""Most runs in one answer of the server."""


async def drop_unplanned(
    client: Any, deployments: Mapping[UUID, Any], schedules: Sequence[Scheduled]
) -> None:
    """Delete schedules that an earlier service left in these deployments, and runs by such.

    Prefect itself only adds and changes schedules: one that was deleted from the file, renamed or
    moved to another flow would go on beside those that the page shows.

    Args:
        deployments: the flow of each.
        schedules: those that are served.
    """
    from prefect.exceptions import ObjectNotFound
    from prefect.states import Scheduled as Due

    for deployment, flow in deployments.items():
        ours = [item for item in schedules if item.flow == flow.name]
        planned: list[Any] = []
        others: list[Any] = []
        for run in await scheduled_runs(client, [deployment]):
            if is_by_schedule(run):
                # none of those either that were planned before a schedule was changed or disabled
                known = await begin_of_run(run, ours) is not None
                (planned if known else others).append(run)
        slugs = {item.slug for item in ours}
        old = [
            there
            for there in await client.read_deployment_schedules(deployment)
            if there.slug not in slugs
        ]
        for there in old:
            await client.delete_deployment_schedule(deployment, there.id)
            console.say(f"deleted: the schedule {there.slug or there.id} of {flow.name}")
        for run in others:
            with suppress(ObjectNotFound):
                await client.delete_flow_run(run.id)
        # with a schedule, the server deletes the late runs of all others: a night that has begun
        for run in planned:
            late = run.expected_start_time <= datetime.now(UTC)
            if old and run.auto_scheduled and late:  # else it was made again, and is still there
                await client.create_flow_run_from_deployment(
                    deployment,
                    parameters=run.parameters,
                    state=Due(scheduled_time=run.expected_start_time),
                    tags=[AGAIN],
                )


def is_by_schedule(run: Any) -> bool:
    """Return whether a schedule planned a run; one that a person resumed has begun before."""
    return run.run_count == 0 and (run.auto_scheduled or AGAIN in run.tags)


def moves_arm(flow: Any) -> bool:
    """Return whether the runs of a flow move the arm."""
    return getattr(flow, "name", "") in MOVING


async def cancel_missed(client: Any, deployments: Mapping[UUID, Any]) -> None:
    """Cancel late runs that move the arm and have no window: they would begin at any hour."""
    moving = [deployment for deployment, flow in deployments.items() if moves_arm(flow)]
    for run in await scheduled_runs(client, moving):
        late = run.expected_start_time <= datetime.now(UTC)
        if late and "until" not in run.parameters.get("wanted", {}):
            await cancel(client, run, "missed while the service was down")


async def cancel(client: Any, run: Any, why: str) -> None:
    """Cancel a run that has not begun."""
    from prefect.states import Cancelled

    await client.set_flow_run_state(run.id, Cancelled(message=why))
    console.say(f"cancelled: {run.name}, due {run.expected_start_time:%Y-%m-%d %H:%M %Z}: {why}")


async def scheduled_runs(client: Any, deployments: Sequence[UUID]) -> list[Any]:
    """Return the runs that have not begun, those that are due first."""
    from prefect.client.schemas.filters import (
        FlowRunFilter,
        FlowRunFilterDeploymentId,
        FlowRunFilterState,
        FlowRunFilterStateType,
    )
    from prefect.client.schemas.objects import StateType
    from prefect.client.schemas.sorting import FlowRunSort

    asked = FlowRunFilter(
        deployment_id=FlowRunFilterDeploymentId(any_=list(deployments)),
        state=FlowRunFilterState(type=FlowRunFilterStateType(any_=[StateType.SCHEDULED])),
    )
    found: list[Any] = []
    while more := await client.read_flow_runs(
        flow_run_filter=asked,
        sort=FlowRunSort.EXPECTED_START_TIME_ASC,
        limit=PAGE,
        offset=len(found),
    ):
        found += more
    return found

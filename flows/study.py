"""The whole chain: collect every protocol, synchronise, then label, train, evaluate and report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from flows import console
from flows.campaigns import collected
from flows.collect import collect
from flows.evaluate import evaluate
from flows.label import label
from flows.orders import Order
from flows.report import report
from flows.sync import sync
from flows.train import train
from storage.store import Store


@dataclass(frozen=True)
class Outcome:
    """What every step of a study did."""

    collected: list[dict[str, Any]]
    steps: list[dict[str, Any]]


def study(orders: list[Order]) -> Outcome:
    """Run what is missing or stale, step by step; a step with nothing to do says so."""
    done = []
    for order in orders:
        result = collect(order)
        done.append(result)
        if not result["taken"]:
            console.say(f"collect {order.campaign}: nothing to do")
    store = Store.open(orders[0].store)
    campaigns = collected(store, [order.campaign for order in orders])
    steps = []
    for step in (sync, label, train, evaluate, report):
        result = step(store, campaigns)
        steps.append(result)
        if not result["done"]:
            console.say(f"{result['step']}: nothing to do")
    return Outcome(done, steps)

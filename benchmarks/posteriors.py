"""Posteriors of known worlds: our regression beside rejection and neural posterior estimation.

    python -m benchmarks.posteriors [--worlds 300] [--hidden 100] [--banks 2] [--toys NAME ...]
    python -m benchmarks.posteriors --bank FILE.npz        # simulated worlds instead of toys

Every method gets the same simulated worlds and gives 95 % intervals of hidden worlds drawn from the
same prior. The rivals: plain rejection (the nearest twentieth of the worlds in standardised
statistics; Pritchard et al. 1999) and neural posterior estimation with a masked autoregressive flow
and sbi's defaults (Tejero-Cantero et al. 2020), where `sbi` is installed: it is no dependency. Both
get statistics that are standardised and cut off as ours are, in which rejection gains most.

A file has the arrays `theta`, `s`, `lower`, `upper` as in `Bank`, `parameters` and `statistics`;
its last worlds are the hidden ones.
"""

from __future__ import annotations

import argparse
import importlib.util
import tempfile
import time
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path

import numpy as np

from benchmarks.measure import SEED
from sliplab.plugins.twin.posterior import IDENTIFIED, Bank, fitted
from sliplab.storage.streams import F64

HALF = float(np.log(1.3))
LEVELS = (0.025, 0.5, 0.975)
HEAD = (
    "| worlds | method | held (by parameter) | called identified | held of these "
    "| median error of these | median width left | parameters with any | seconds |"
)
Method = Callable[[Bank, F64], F64]
"""From a bank and observations (n, q) to quantiles (3, n, p)."""


def linear(unit: F64, rng: np.random.Generator) -> F64:
    """Ten linear statistics of five parameters, noise of a tenth of the prior's half width."""
    mix = np.random.default_rng(5).normal(size=(unit.shape[1], 10))
    return unit @ mix + 0.4 * rng.normal(size=(len(unit), 10))


def ridge(unit: F64, rng: np.random.Generator) -> F64:
    """The product of two parameters, and four statistics that say nothing."""
    total = unit.sum(axis=1) + 0.04 * rng.normal(size=len(unit))
    return np.column_stack([total, rng.normal(size=(len(unit), 4))])


def uneven(unit: F64, rng: np.random.Generator) -> F64:
    """Noise that grows twelvefold over the prior, and five statistics that say nothing."""
    noise = 0.08 * np.exp(1.25 * (unit[:, :1] + 1.0)) * [1.0, 0.3]
    return np.column_stack(
        [unit + noise * rng.normal(size=unit.shape), rng.normal(size=(len(unit), 5))]
    )


def curved(unit: F64, rng: np.random.Generator) -> F64:
    """An exponential, a parabola, a product and a fold, and six statistics that say nothing."""
    a, b, c = unit.T
    s = np.column_stack([np.exp(1.5 * a), b**2 + 0.5 * b, a * b + c, np.abs(c - 0.3)])
    return np.column_stack([s + 0.05 * rng.normal(size=s.shape), rng.normal(size=(len(unit), 6))])


def crowded(unit: F64, rng: np.random.Generator) -> F64:
    """Four telling statistics among 176 Cauchy ones, for eight parameters."""
    s = rng.standard_cauchy((len(unit), 180))
    s[:, :3] = unit[:, :3] + 0.1 * rng.standard_t(2, (len(unit), 3))
    s[:, 3] = unit[:, 3] + 0.5 * rng.normal(size=len(unit))
    return s


def many(unit: F64, rng: np.random.Generator) -> F64:
    """100 statistics of 31 parameters, of which 20 show: mixed, curved, uneven, some missing."""
    fixed = np.random.default_rng(31)
    p, q = unit.shape[1], 100
    mix = np.where(fixed.random((p, q)) < 0.08, fixed.normal(size=(p, q)), 0.0)
    mix[np.arange(q) % 20, np.arange(q)] += 1.0
    bend = np.where(fixed.random((p, q)) < 0.03, 0.4 * fixed.normal(size=(p, q)), 0.0)
    mix[20:] = bend[20:] = 0.0
    noise = 0.05 * 10 ** fixed.uniform(0, 1.5, q)
    grows = np.exp(unit[:, 3:4] * 0.8 * fixed.normal(size=q))
    s = unit @ mix + unit**2 @ bend + 0.3 * unit[:, :1] * (np.roll(unit, 1, axis=1) @ bend)
    s += noise * grows * rng.standard_t(4, s.shape)
    s[:, 60:] = np.where(rng.random((len(s), 40)) < 0.03, np.nan, s[:, 60:])
    s[:, 90:] = rng.standard_cauchy((len(s), 10))
    return s


TOYS = {
    "linear": (linear, 5),
    "ridge": (ridge, 2),
    "uneven": (uneven, 2),
    "curved": (curved, 3),
    "crowded": (crowded, 8),
    "many": (many, 31),
}


def drawn(name: str, k: int, seed: int) -> Bank:
    """Return k worlds of a toy."""
    toy, p = TOYS[name]
    rng = np.random.default_rng([SEED, seed])
    unit = rng.uniform(-1.0, 1.0, (k, p))
    s = toy(unit, rng)
    return Bank(
        tuple(f"theta{j}" for j in range(p)),
        tuple(f"s{j}" for j in range(s.shape[1])),
        unit * HALF,
        s,
        np.full(p, -HALF),
        np.full(p, HALF),
    )


def by_regression(bank: Bank, observed: F64) -> F64:
    fit = fitted(bank)
    median = np.nanmedian(bank.s, axis=0)
    found = [fit.at(np.where(np.isfinite(row), row, median)).estimates for row in observed]
    return np.array(
        [[[getattr(e, name) for e in row] for row in found] for name in ("low", "median", "high")]
    )


def by_rejection(bank: Bank, observed: F64) -> F64:
    x, o = standardised(bank.s, observed)
    count = max(len(bank) // 20, 20)
    near = np.argsort(((o[:, None] - x) ** 2).sum(axis=2), axis=1, kind="stable")[:, :count]
    result: F64 = np.quantile(bank.theta[near], LEVELS, axis=1)
    return result


def by_flow(bank: Bank, observed: F64) -> F64:
    import torch
    from sbi.inference import NPE
    from sbi.utils import BoxUniform

    torch.manual_seed(SEED)
    torch.set_num_threads(1)
    x, o = (torch.tensor(part, dtype=torch.float32) for part in standardised(bank.s, observed))
    p = len(bank.parameters)
    prior = BoxUniform(-torch.ones(p), torch.ones(p))
    # its log goes into the working folder
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        trainer = NPE(prior, density_estimator="maf", show_progress_bars=False)
        trainer.append_simulations(torch.tensor(bank.unit(bank.theta), dtype=torch.float32), x)
        trainer.train()
    flow = trainer.build_posterior()
    rows = []
    for row in o:
        # its samples outside of the prior are cut off: in 31 dimensions rejection seldom ends
        drawn_unit = flow.sample(
            (1000,), x=row, show_progress_bars=False, reject_outside_prior=False
        )
        unit = drawn_unit.detach().clamp(-1, 1).numpy().astype(np.float64)
        rows.append(np.quantile(bank.scaled(unit), LEVELS, axis=0))
    return np.stack(rows, axis=1)


def standardised(s: F64, observed: F64) -> tuple[F64, F64]:
    """Return statistics of a bank and of observations in units of their spread, cut off at 5."""
    low, centre, high = np.nanquantile(s, [0.25, 0.5, 0.75], axis=0)
    scale = np.where(high > low, (high - low) / 1.349, 1.0)
    x, o = (np.nan_to_num(np.clip((a - centre) / scale, -5, 5)) for a in (s, observed))
    return x, o


METHODS: dict[str, Method] = {"regression": by_regression, "rejection": by_rejection}
if importlib.util.find_spec("sbi"):
    METHODS["sbi NPE"] = by_flow


def compared(name: str, pairs: list[tuple[Bank, Bank]]) -> None:
    """Print a row a method: coverage, of the identified ones too, width, error and time."""
    for method, run in METHODS.items():
        held, left, error = [], [], []
        started = time.perf_counter()
        for bank, hidden in pairs:
            low, median, high = run(bank, hidden.s)
            held.append((low <= hidden.theta) & (hidden.theta <= high))
            left.append((high - low) / (0.95 * (bank.upper - bank.lower)))
            error.append(np.abs(np.expm1(median - hidden.theta)))
        seconds = (time.perf_counter() - started) / len(pairs)
        holds, share, off = map(np.concatenate, (held, left, error))
        called = share <= IDENTIFIED
        telling = np.median(share, axis=0) < 0.9
        of_called = f"{100 * holds[called].mean():.1f} %" if called.any() else "-"
        error_called = f"{100 * np.median(off[called]):.2f} %" if called.any() else "-"
        print(
            f"| {name} | {method} | {100 * holds.mean():.1f} % "
            f"({100 * holds.mean(axis=0).min():.0f} to {100 * holds.mean(axis=0).max():.0f}) "
            f"| {100 * called.mean():.0f} % | {of_called} | {error_called} "
            f"| {100 * np.median(share):.0f} % | {telling.sum()} of {len(telling)} "
            f"| {seconds:.1f} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--worlds", type=int, default=300)
    parser.add_argument("--hidden", type=int, default=100)
    parser.add_argument("--banks", type=int, default=2)
    parser.add_argument("--bank", type=Path, help="simulated worlds instead of the toys")
    parser.add_argument("--toys", nargs="*", default=list(TOYS))
    asked = parser.parse_args()
    print(HEAD)
    print("|" + " --- |" * 9)
    if asked.bank:
        stored = dict(np.load(asked.bank))
        names = tuple(map(str, stored["parameters"])), tuple(map(str, stored["statistics"]))
        bounds = stored["lower"], stored["upper"]
        k = len(stored["theta"]) - asked.hidden
        bank, hidden = (
            Bank(*names, stored["theta"][part], stored["s"][part], *bounds)
            for part in (slice(None, k), slice(k, None))
        )
        compared(asked.bank.stem, [(bank, hidden)])
        return
    for name in asked.toys:
        compared(
            name,
            [
                (drawn(name, asked.worlds, 2 * i), drawn(name, asked.hidden, 2 * i + 1))
                for i in range(asked.banks)
            ],
        )


if __name__ == "__main__":
    main()

"""The paper's Table 1 on one skill: what the contact graph and the product of rewards are worth, at equal samples.

``python -m policies.skillmimic.ablation g1-ball hold`` trains every variant of ``rewards.VARIANTS`` with several seeds and
prints success over episodes that no training has seen. What is trained already is not trained again. The paper's policies
find out by themselves that a ball is to be pressed; so do these: the plan is the bare clip, without corrections and grip.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro

from policies.evaluate import Rate
from policies.skillmimic.card import SECONDS
from policies.skillmimic.config import TASKS, SkillMimic, Task, check_skill
from policies.skillmimic.evaluate import Result, performed
from policies.skillmimic.rewards import SENSITIVITIES, VARIANTS
from policies.skillmimic.train import SkillTraining, load_graph
from sim2real.options import Count, MaybeNewFile, Positive

FOLDER = Path("runs/ablation")
# Steps of a learner that has everything to find, and is to have found some of it after 0.2 M samples.
LARGE = {"frames": 150, "push_chance": 0.01, "learning_rate": 5e-4, "std": 0.15}
HEAD = "What the contact graph and the product of rewards are worth"
NOTE = """Written by `python -m policies.skillmimic.ablation`; do not edit. The paper's Table 1: one skill, one reward each
(equations of its appendix B.1), the same samples, networks and settings. The plan under the policy is the bare clip: no
corrections, and nothing presses the ball, so that this has to be learned. Success as in the policy's card, over 10 s, with
95 % confidence: of the pooled episodes (Wilson), and of the mean over seeds (Student's t), which is the one to compare
variants by. Acc., E_o and E_cg as in the paper's section 6.2."""


def bare(task: str, seed: int, samples: float) -> SkillMimic:
    """The task's settings with a plan that is the bare clip, and so with larger steps. Nothing is selected: the last
    checkpoint counts."""
    config = dataclasses.replace(TASKS[task], corrections=None, grip=0.0, seed=seed, samples=samples)
    return dataclasses.replace(config, evaluate_every=10**9, **LARGE)


def config_of(task: str, skill: str, variant: str, seed: int, samples: float) -> SkillMimic:
    """The same, with one skill and one reward."""
    config = bare(task, seed, samples)
    clips = tuple(c for c in config.clips if c.rsplit("_", 1)[0] == skill)
    sensitivity = variant if variant in SENSITIVITIES else config.sensitivity
    return dataclasses.replace(config, skills=(skill,), clips=clips, variant=variant, sensitivity=sensitivity)


def train(config: SkillMimic, folder: Path) -> None:
    """To the end, from wherever ``folder`` is."""
    run = SkillTraining(config, folder)
    run.resume()
    run.run()


def pooled(results: Sequence[Result]) -> Rate:
    """All seeds' episodes."""
    return Rate(sum(r.success.survived for r in results), sum(r.success.episodes for r in results))


def between(results: Sequence[Result]) -> tuple[float, float]:
    """Mean success, and half its 95 % confidence interval over seeds (Student's t for 2 to 5 of them)."""
    values = np.array([r.success.value for r in results])
    t = {2: 12.71, 3: 4.30, 4: 3.18, 5: 2.78}[len(values)]
    return float(values.mean()), float(t * values.std(ddof=1) / np.sqrt(len(values)))


def table(found: dict[str, list[Result]]) -> str:
    """Markdown, a row a variant."""
    rows = []
    for variant, results in found.items():
        mean, half = between(results)
        acc, ball, edges = (
            np.mean([getattr(r, n) for r in results]) for n in ("accuracy", "ball_error", "contact_error")
        )
        seeds = ", ".join(f"{r.success.value:.0%}" for r in results)
        rows.append(
            f"| `{variant}` | {VARIANTS[variant].equation} | {pooled(results)} | {mean:.0%} +- {half:.0%} ({seeds}) | {acc:.3f} |"
            f" {ball:.3f} | {edges:.3f} |"
        )
    head = (
        "| variant | equation | success, pooled | over seeds | Acc. | E_o m | E_cg |\n|---|---|---|---|---|---|---|\n"
    )
    return head + "\n".join(rows)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What every comparison asks for."""

    task: tyro.conf.Positional[Task]
    """whose settings"""
    samples: Positive = 0.3e6
    """of a run with one skill"""
    seeds: Literal[1, 2, 3, 4, 5] = 2
    """runs of each kind"""
    episodes: Count = 100
    """of each seed"""
    report: MaybeNewFile = None
    """write the table to this Markdown file"""


@dataclass(frozen=True, kw_only=True)
class Args(Comparison):
    """The paper's Table 1 on one skill."""

    skill: tyro.conf.Positional[str]
    """which of the task's"""
    variants: tuple[Literal["skillmimic", "no_cgr", "no_multiplication", "deepmimic", "amp"], ...] = (
        "skillmimic",
        "no_cgr",
        "no_multiplication",
        "deepmimic",
        "amp",
    )
    """rewards to compare"""
    seeds: Literal[2, 3, 4, 5] = 3
    """runs of each reward"""


def tell(text: str, report: Path | None, head: str, note: str) -> None:
    """Print what came out, and write it to ``report`` under its head and note."""
    print(f"\n{text}")
    if report:
        report.write_text(f"# {head}\n\n{note}\n\n{text}")


def main() -> None:
    a = tyro.cli(Args, prog="python -m policies.skillmimic.ablation")
    check_skill(a.skill, TASKS[a.task].skills)
    torch.set_num_threads(1)
    found: dict[str, list[Result]] = {variant: [] for variant in a.variants}
    for seed in range(1, a.seeds + 1):
        for variant in a.variants:
            folder = FOLDER / f"{a.task}-{a.skill}-{variant}-{seed}"
            train(config_of(a.task, a.skill, variant, seed, a.samples), folder)
            found[variant].append(performed(load_graph(folder, "last.pt"), a.skill, a.episodes, SECONDS).result())
            print(f"{variant}, seed {seed}: {found[variant][-1].success}", flush=True)
    text = f"`{a.skill}`, {a.samples / 1e6:g} M samples a run, {a.seeds} seeds, {a.episodes} episodes each:\n\n{table(found)}\n"
    tell(text, a.report, HEAD, NOTE)


if __name__ == "__main__":
    main()

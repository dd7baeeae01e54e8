"""``sim2real eval``: every number of a policy's card, measured and written down."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from policies.basics import MOTIONS, Basics
from policies.evaluate import (
    Episodes,
    FileActor,
    Rate,
    random_script,
    run_episodes,
    skill_script,
    switch_script,
)
from policies.parts import Parts, kept
from policies.randomisation import TABLE
from policies.through_bytes import deploy_episode, stayed_up
from sim2real.contract import Contract
from sim2real.policy import load_policy
from sim2real.types import Sim2realError

SECONDS = 10.0  # of an episode
PUSH = 0.5  # m/s
SINGLE = (0.2, 0.3, 0.4, 0.5)  # m/s
WALK, WALK_SECONDS = (0.5, 0.0, 0.0), 20.0  # m/s, m/s, rad/s; s
EVERY = 2.5  # s between the skill changes of the deployed runs


@dataclass(frozen=True)
class Evaluation:
    """What was measured of one file. Rates are of episodes of SECONDS, unless said otherwise."""

    sha256: str
    calm: dict[str, Rate]  # by label
    pushed: dict[str, Rate]
    error: dict[str, float]  # rad, mean distance of the joints from their reference, undisturbed
    single: dict[str, Rate]  # one push of exactly so many m/s at 3 s of 6 s, any skill
    switches: dict[str, Rate]  # "first > second"
    walk: Rate  # WALK_SECONDS of walking at WALK, pushed up to PUSH every 1.5 to 4 s
    walk_velocity: tuple[float, float]  # m/s, mean forwards and to the left
    trained: Rate  # random skills, in the training environment
    deployed: Rate  # the same, through the bytes
    deployed_pushed: Rate
    margin: float  # rad, the closest a joint of the deployed runs came to its mechanical range
    margin_of: str
    torque_share: float  # of a joint's limit, the largest of the deployed runs
    faults: list[str]  # that the safety gate found in them

    @property
    def gap(self) -> float:
        """Survival lost from the training environment to the deployed loop, in percentage points."""
        return 100 * (self.trained.value - self.deployed.value)

    def as_dict(self) -> dict[str, Any]:
        """JSON-able, with the interval of every rate."""
        rate = lambda r: {**r._asdict(), "value": r.value, "interval": r.interval}  # noqa: E731
        return {
            f.name: rate(v)
            if isinstance(v, Rate)
            else {k: rate(r) for k, r in v.items()}
            if isinstance(v, dict) and all(isinstance(r, Rate) for r in v.values())
            else v
            for f in dataclasses.fields(self)
            for v in (getattr(self, f.name),)
        } | {"gap": self.gap}


def evaluate(path: Path, config: Basics, episodes: int, deployed: int, parts: Parts) -> Evaluation:
    """Measure a policy file: ``episodes`` per skill and a fifth of that per switch, ``deployed`` runs through the bytes.

    Raises Sim2realError if the file is refused or was made with other settings.
    """
    torch.set_num_threads(1)  # small networks: more threads only wait for each other
    labels = list(MOTIONS)
    pairs, switches = switch_script(config, len(labels), max(1, episodes // 5))
    skills = skill_script(config, len(labels), episodes, SECONDS)
    mixed = random_script(config, len(labels), episodes, SECONDS, EVERY)
    actor = FileActor(path, max(map(len, (switches, skills, mixed))))
    calm = parts.once(f"every skill, {episodes} episodes each", run_episodes, config, actor, skills, seed=1)
    pushed = parts.once(f"every skill, pushed up to {PUSH:g} m/s", run_episodes, config, actor, skills, PUSH, seed=2)
    single = {}
    for speed in SINGLE:
        pushes = dataclasses.replace(config, push=(3.0, 3.0), push_least=1.0)
        script = mixed[:, : round(5.9 / config.period)]
        found = parts.once(f"one push of {speed:g} m/s", run_episodes, pushes, actor, script, speed, seed=6)
        single[f"{speed:g}"] = found.rate()
    switched = parts.once(f"all {len(pairs)} switches", run_episodes, config, actor, switches, seed=3)
    walk = np.full((min(episodes, len(mixed)), round(WALK_SECONDS / config.period)), labels.index("walk"))
    walked = parts.once("a long walk, pushed", run_episodes, config, actor, walk, PUSH, seed=7, command=WALK)
    trained = parts.once("random skills", run_episodes, config, actor, mixed, seed=4)
    runs = {}
    for push in (0.0, PUSH):
        rows = random_script(config, len(labels), deployed, SECONDS, EVERY, seed=5)
        each = [(path, config, steps(r, labels, config.period), push, k) for k, r in enumerate(rows)]
        text = f"{deployed} runs through the bytes" + (", pushed" if push else "")
        runs[push] = parts.each(text, deploy_episode, each)
    summaries = [summary for row in runs.values() for summary in row]
    closest = min(summaries, key=lambda s: s.joint_margin)
    survived = {push: Rate(sum(stayed_up(s, SECONDS) for s in row), len(row)) for push, row in runs.items()}
    return Evaluation(
        sha256=load_policy(path, trial=0).sha256,
        calm=by(labels, calm, episodes),
        pushed=by(labels, pushed, episodes),
        error={label: float(calm.error[k * episodes : (k + 1) * episodes].mean()) for k, label in enumerate(labels)},
        single=single,
        switches=by([f"{labels[a]} > {labels[b]}" for a, b in pairs], switched, len(switches) // len(pairs)),
        walk=walked.rate(),
        walk_velocity=(float(walked.velocity[:, 0].mean()), float(walked.velocity[:, 1].mean())),
        trained=trained.rate(),
        deployed=survived[0.0],
        deployed_pushed=survived[PUSH],
        margin=closest.joint_margin,
        margin_of=closest.joint_margin_of,
        torque_share=max(s.torque_share for s in summaries),
        faults=sorted({fault for s in summaries for fault in s.faults}),
    )


def by(names: list[str], episodes: Episodes, each: int) -> dict[str, Rate]:
    """Rates of consecutive groups of ``each`` episodes."""
    return {name: episodes.rate(slice(k * each, (k + 1) * each)) for k, name in enumerate(names)}


def steps(row: np.ndarray, labels: list[str], period: float) -> list[tuple[str, float]]:
    """A row of label indices per tick as (label, seconds)."""
    edges = [0, *(np.flatnonzero(np.diff(row)) + 1), len(row)]
    return [(labels[row[a]], float((b - a) * period)) for a, b in zip(edges[:-1], edges[1:], strict=True)]


def card(contract: Contract, e: Evaluation) -> str:
    """The policy's card, Markdown."""
    training = contract.provenance.training
    worst = min(e.switches.items(), key=lambda item: item[1].value)
    total = Rate(sum(r.survived for r in e.switches.values()), sum(r.episodes for r in e.switches.values()))
    skills = "\n".join(
        f"| `{s.label}` | {s.description} | {e.calm[s.label]} | {e.pushed[s.label]} | {e.error[s.label]:.3f} |"
        for s in contract.skills
    )
    ranges = "\n".join(f"| {name} | {t.low:g} to {t.high:g} | {t.why} |" for name, t in TABLE.items())
    return f"""# {contract.name}, a policy for {contract.robot}

Measured by `sim2real eval`; do not edit. sha256 `{e.sha256}`

{1 / contract.period:.0f} Hz, {len(contract.target_joint_names)} joints. In: {", ".join(n for n in contract.inputs if not n.startswith("carry_"))}.
Legs and waist balance around a reference that every skill (`policies/basics.py`) and the gait (`policies/gait.py`) give by
formula; arms follow it.
Trained by {training.get("algorithm", "?")} on {float(training.get("samples", 0)) / 1e6:.1f} M samples, seed {training.get("seed", "?")}, revision {contract.provenance.revision[:12]}.
{training.get("note", "")}

## Survival

Share of {SECONDS:g} s episodes without a fall, with 95 % confidence, on robots that training never drew. Pushes: up to
{PUSH:g} m/s in any direction, every 1.5 to 4 s.

| skill | what it does | undisturbed | pushed | joint error, rad |
|---|---|---|---|---|
{skills}

- One push of exactly 0.2, 0.3, 0.4, 0.5 m/s in a random direction: {", ".join(f"{r.value:.0%}" for r in e.single.values())}
  survive the next 3 s ({e.single["0.5"].episodes} episodes each).
- {WALK_SECONDS:g} s of walking at {WALK[0]:g} m/s, pushed as above: {e.walk}; {e.walk_velocity[0]:.3f} m/s forwards, {e.walk_velocity[1]:+.3f} m/s to the left.
- Every ordered switch: {total}; the worst, `{worst[0]}`, {worst[1].survived} of {worst[1].episodes}.
- Random skills every {EVERY:g} s: {e.trained} in the training environment, {e.deployed} through the bytes (real codecs,
  emulated motors, safety gate; a fault counts as a fall): {e.gap:+.1f} points lost. Pushed, through the bytes: {e.deployed_pushed}.
- Through the bytes the closest any joint came to its mechanical range is {e.margin:.3f} rad (`{e.margin_of}`), the largest
  torque {e.torque_share:.0%} of the joint's limit. Faults found by the gate: {", ".join(e.faults) or "none"}.

## What it was trained on

| quantity | range | why |
|---|---|---|
{ranges}

## Limits

- Flat ground only.
- It has only ever seen the simulated body of `configs/robots/{contract.robot}.xml`; nobody has run it on hardware.
- The skills are formulas, not human motion: they show that the path from training to motors is sound.
"""


def eval_command(
    file: Path, episodes: int, deployed: int, report: Path | None, card_file: Path | None, **of_ball_skills: Any
) -> bool:
    """``sim2real eval``: measure, print, write. Returns whether undisturbed survival is at least 95 % everywhere; of skills
    with an object, see policies/skillmimic/card.py, which alone knows ``of_ball_skills``. Raises Sim2realError where such
    are given for another policy."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    policy = load_policy(file)
    contract = policy.contract
    if contract.object is not None:
        from policies.skillmimic.card import eval_command as eval_ball_skills

        return eval_ball_skills(file, episodes, deployed, report, card_file, **of_ball_skills)
    if given := [f"--{name}" for name, value in of_ball_skills.items() if value]:
        raise Sim2realError(f"{', '.join(given)}: belongs to ball skills, and {file} handles no ball; drop it")
    with kept(console, file.stem, policy.sha256, episodes, deployed) as parts:
        e = evaluate(file, Basics(), episodes, deployed, parts)
    table = Table(title=f"{contract.name}: survival of {SECONDS:g} s (95 % confidence)", box=None)
    for column in ("skill", "undisturbed", f"pushed to {PUSH:g} m/s", "joint error"):
        table.add_column(column)
    for label in contract.skill_labels:
        table.add_row(label, str(e.calm[label]), str(e.pushed[label]), f"{e.error[label]:.3f} rad")
    console.print(table)
    table = Table(title="switches, first to second", box=None)
    for column in ("", *contract.skill_labels):
        table.add_column(column)
    for first in contract.skill_labels:
        rates = [e.switches.get(f"{first} > {second}") for second in contract.skill_labels]
        table.add_row(first, *(f"{r.survived}/{r.episodes}" if r else "-" for r in rates))
    console.print(table)
    console.print(
        f"walking at {WALK[0]:g} m/s for {WALK_SECONDS:g} s, pushed: {e.walk}; {e.walk_velocity[0]:.3f} m/s forwards"
    )
    console.print("one push: " + ", ".join(f"{speed} m/s {rate.value:.0%}" for speed, rate in e.single.items()))
    console.print(
        f"random skills: {e.trained} in training, {e.deployed} through the bytes, {e.gap:+.1f} points lost\n"
        f"pushed, through the bytes: {e.deployed_pushed}; faults: {', '.join(e.faults) or 'none'}"
    )
    if report:
        report.write_text(json.dumps(e.as_dict(), indent=1) + "\n")
    if card_file:
        card_file.write_text(card(contract, e))
    return min(r.value for r in (*e.calm.values(), *e.switches.values(), e.deployed)) >= 0.95

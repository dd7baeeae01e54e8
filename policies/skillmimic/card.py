"""``sim2real eval`` of a ball skill: in training's own world, through the bytes knowing the ball, and seeing it."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from policies.evaluate import FileActor, Rate
from policies.parts import Array, Parts, kept
from policies.skillmimic.curves import PAPER, Curve, learned, read, svg
from policies.skillmimic.evaluate import BALL_NEAR, BODY_NEAR, Episodes, Result, performed, rule_of
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.release import graph_of, network_in
from policies.skillmimic.tables import CELLS, FIRST, NOMINAL, REST, SECOND, pairs, sweep, switched
from policies.skillmimic.through_bytes import BEFORE, graph_in, judged
from sim2real.contract import Contract
from sim2real.object.camera import SIGHTS, Sight
from sim2real.object.scene import AIMING
from sim2real.policy import load_policy

SECONDS = 10.0  # of an episode; that of a skill that ends by itself ends with its clip
TARGETS = {"hold": 0.95, "raise": 0.95, "carry": 0.95, "pass": 0.85, "shot": 0.85, "pickup": 0.70, "catch": 0.70,
           "dribble_in_place": 0.60, "bounce": 0.60, "bounce_walk": 0.60}  # fmt: skip
FILES = 50  # robots of an environment that have a policy file each
CELL = 25  # episodes of a cell of the tables, at most
GAP = 0.05  # of success, the most that may be lost from training's world to the bytes with a camera
WAYS = {
    "training": "training environment",
    "truth": "bytes, ball known",
    "camera": "bytes, ball seen",
    "capture": "bytes, by motion capture",
}


class Evaluation(NamedTuple):
    """What was measured of one file: way of WAYS -> label -> Result; and the paper's Tables 2 and 3, or neither."""

    sha256: str
    results: dict[str, dict[str, Result]]
    sweeps: dict[str, dict[str, Rate]] = {}  # label -> "radius x 0.5" -> success
    switches: dict[str, Rate] = {}  # "first > second" -> success of the second

    def gap(self, label: str) -> float:
        """Success lost from training's world to the bytes with a camera."""
        return self.results["training"][label].success.value - self.results["camera"][label].success.value

    def good(self, label: str) -> bool:
        """Whether a label meets its target through the bytes with a camera, and loses at most GAP on the way there."""
        return self.results["camera"][label].success.value >= TARGETS.get(label, 0.95) and self.gap(label) <= GAP

    def as_dict(self) -> dict[str, Any]:
        """JSON-able, with the interval of every rate."""
        rate = lambda r: {**r._asdict(), "interval": r.interval}  # noqa: E731
        document: dict[str, Any] = {"sha256": self.sha256}
        for way, results in self.results.items():
            document[way] = {label: {**r._asdict(), "success": rate(r.success)} for label, r in results.items()}
        if self.sweeps:
            document["sweeps"] = {label: {k: rate(r) for k, r in row.items()} for label, row in self.sweeps.items()}
            document["switches"] = {pair: rate(r) for pair, r in self.switches.items()}
        return document


class BallActor(FileActor):
    """A policy file in ``FILES`` robots of this package's environment, and the file's network alone in those beyond: that is
    one product for all of them."""

    settings = "policies/skillmimic/config.py"

    def __init__(self, path: Path, robots: int) -> None:
        super().__init__(path, min(robots, FILES), network_in(path) if robots > FILES else None)

    def signals(self, env: Any) -> dict[str, torch.Tensor]:
        return env.inputs

    def begin(self, env: Any, k: int) -> None:
        """Training starts anywhere in a clip, with a memory that fits there."""
        self.policies[k].reset({name: carry[k].numpy() for name, carry in env.carries.items()})


def evaluate(
    path: Path, episodes: int, deployed: int, parts: Parts, tables: bool = False, capture: bool = False
) -> Evaluation:
    """Measure a policy file: ``episodes`` per skill in training's world, ``deployed`` per skill and way through the bytes;
    with ``capture``, seen by motion capture too; with ``tables``, a fifth of ``episodes``, at most ``CELL``, per cell of the
    paper's Tables 2 and 3.

    Raises Sim2realError if the file is refused or was made with other settings.
    """
    torch.set_num_threads(1)
    policy = load_policy(path, trial=0)
    graph = graph_of(policy.contract)
    trained = parts.each(
        f"training environment, {episodes} episodes a skill", in_training, [(path, n, episodes) for n in graph.labels]
    )
    results = {
        "training": dict(zip(graph.labels, trained, strict=True)),
        "truth": through_bytes(path, graph, deployed, None, parts),
        "camera": through_bytes(path, graph, deployed, "camera", parts),
    }
    if capture:
        results["capture"] = through_bytes(path, graph, deployed, "capture", parts)
    if not tables:
        return Evaluation(policy.sha256, results)
    each = max(1, min(CELL, episodes // 5))
    balls = parts.each(f"other balls, {each} episodes a cell", with_balls, [(path, n, each) for n in graph.labels])
    switches = pairs(graph)
    shares = parts.each(
        f"one skill after another, {each} episodes a pair",
        one_after_another,
        [(path, *pair, each) for pair in switches],
    )
    rates = {
        f"{a} > {b}": Rate(round(float(s.sum())), len(s)) for (a, b), s in zip(switches, shares, strict=True) if len(s)
    }
    return Evaluation(policy.sha256, results, dict(zip(graph.labels, balls, strict=True)), rates)


def in_training(path: Path, label: str, episodes: int) -> Result:
    """``episodes`` of one skill of a policy file in training's world."""
    return performed(graph_in(path), label, episodes, SECONDS, seed=1, act=BallActor(path, episodes)).result()


def with_balls(path: Path, label: str, each: int) -> dict[str, Rate]:
    """A skill of a policy file with other balls, ``each`` episodes a cell."""
    return sweep(graph_in(path), label, each, SECONDS, BallActor(path, each * len(CELLS)))


def one_after_another(path: Path, first: str, second: str, each: int) -> Array:
    """Success of a policy file's ``second`` skill after its ``first``, of ``each`` episodes."""
    return switched(graph_in(path), first, second, each, BallActor(path, each))


def through_bytes(
    path: Path, graph: PolicyGraph, episodes: int, sight: Sight | None, parts: Parts
) -> dict[str, Result]:
    """``episodes`` of every skill in the deployed loop, its clips in turn. ``sight`` None: the ball is known."""
    results, model = {}, SIGHTS[sight] if sight else None
    for k, label in enumerate(graph.labels):
        clips = np.flatnonzero(graph.clips.skill == k)
        each = [(path, int(clips[i % len(clips)]), SECONDS, model, i) for i in range(episodes)]
        text = f"{label}: {episodes} runs through the bytes, the ball {f'seen by {sight}' if sight else 'known'}"
        runs = parts.each(text, judged, each)
        good, sums, frames = (np.array(column) for column in zip(*runs, strict=True))
        results[label] = Episodes(good, sums, np.maximum(frames, 1)).result()
    return results


def card(
    contract: Contract, e: Evaluation, curve: Curve | None = None, pictures: Mapping[str, str] | None = None
) -> str:
    """The policy's card, Markdown. ``pictures``: links to one of each skill, and to that of the "curve"."""
    training, pictures = contract.provenance.training, pictures or {}
    rows = "\n".join(
        f"| `{label}` | {WAYS[way]} | {r.success} | {r.accuracy:.3f} | {r.body_error:.3f} | {r.ball_error:.3f} |"
        f" {r.contact_error:.3f} |"
        for label in contract.skill_labels
        for way in e.results
        for r in (e.results[way][label],)
    )
    verdicts = "\n".join(
        f"- `{label}`: {rule(label)} Target {TARGETS.get(label, 0.95):.0%} through the bytes with a camera, and at most"
        f" {100 * GAP:g} points lost on the way there: {'met' if e.good(label) else '**missed**'} ({100 * e.gap(label):+.1f} points)."
        for label in contract.skill_labels
    )
    throw = json.loads(str(training.get("settings", "{}"))).get("throw", 0.0)
    planned = float(training.get("plan_samples", 0)) / 1e6
    plan = f"; the arms' plan under it was found by CMA-ES on {planned:.1f} M samples" if planned else ""
    films = "".join(f"![{label}]({pictures[label]})\n" for label in contract.skill_labels if label in pictures)
    return f"""# {contract.name}, ball skills for {contract.robot}

Measured by `sim2real eval`; do not edit. sha256 `{e.sha256}`

{1 / contract.period:.0f} Hz, {len(contract.target_joint_names)} joints. In: {", ".join(n for n in contract.inputs if not n.startswith("carry_"))}.
Trained by {training.get("algorithm", "?")} ({training.get("variant", "?")}) on {float(training.get("samples", 0)) / 1e6:.1f} M samples{plan}; seed {training.get("seed", "?")}, revision {contract.provenance.revision[:12]}.

{films}
## How well

Success, with 95 % confidence, of episodes of {SECONDS:g} s, or of the whole clip and a second where a skill ends by itself; by
each skill's own rule, which for all of them includes: no termination of the training (fallen, tilted, ball lost), and
through the bytes no fault of the safety gate. Acc., E_b, E_o (m) and E_cg as in the paper (section 6.2), a right frame
being one with the ball within {BALL_NEAR:g} m, the body within {BODY_NEAR:g} m and every contact right: the paper's thresholds
times the robot's length scale. Robots, balls and trackers are drawn from randomisation that training never saw; through
the bytes, bodies and balls. In training's environment {FILES} robots of each skill have the file itself, and the others its
network over the same formulas. A ball that is thrown flies up to {throw:g} m/s otherwise than in its clip, along each axis.

| skill | where | success | Acc. | E_b | E_o | E_cg |
|---|---|---|---|---|---|---|
{rows}

{verdicts}

Through the bytes a skill begins from the soft start, or, with the ball in the hands, from {BEFORE:g} s of
`{contract.default_skill}`, and not from its clip's first frame. A simulated person hands the ball over, or aims for {AIMING:g} s and throws
it as in the clip; so they do in the training environment.
{table_2(e)}{table_3(e)}{learning(curve, pictures)}"""


def rule(label: str) -> str:
    """What a success of this skill is, as a sentence."""
    return " ".join((rule_of(label).__doc__ or "").split())


def table_2(e: Evaluation) -> str:
    """Success with other balls, Markdown; empty if it was not measured."""
    if not e.sweeps:
        return ""
    columns = list(next(iter(e.sweeps.values())))
    rows = "\n".join(
        f"| `{label}` | " + " | ".join(f"{row[c].value:.0%}" for c in columns) + " |" for label, row in e.sweeps.items()
    )
    each = next(iter(next(iter(e.sweeps.values())).values())).episodes
    return f"""
## Other balls (the paper's Table 2)

Success in the training environment, {each} episodes a cell, of balls of {NOMINAL}, times the factor in one property; all else
is randomised as ever. A larger ball of the same density is heavier. The paper's restitutions x 1.4 and more are left out:
here they would return more than they got.

| skill | {" | ".join(columns)} |
|---|{"---|" * len(columns)}
{rows}
"""


def table_3(e: Evaluation) -> str:
    """Success of one skill after another, Markdown; empty if it was not measured."""
    if not e.switches:
        return ""
    rows = "\n".join(f"| `{pair}` | {rate} |" for pair, rate in e.switches.items())
    return f"""
## One skill after another (the paper's Table 3)

Success of the second, by its rule over {SECOND:g} s, in the training environment, after {FIRST:g} s of the first (or its clip and
{REST:g} s); of the robots that had not failed by then. Every pair of which the first ends, and the second begins, with the
ball in both hands.

| first > second | success |
|---|---|
{rows}
"""


def learning(curve: Curve | None, pictures: Mapping[str, str]) -> str:
    """What it took, Markdown; empty if no run was given."""
    if curve is None:
        return ""
    return f"""
## What it took

Success as training measures itself (few episodes, pushed), over samples; the paper spends {PAPER / 1e9:.2f} billion on a skill.

![success over samples]({pictures["curve"]})

{learned(curve, TARGETS)}
"""


def eval_command(
    file: Path,
    episodes: int,
    deployed: int,
    report: Path | None,
    card_file: Path | None,
    tables: bool = False,
    runs: Sequence[Path] = (),
    videos: Path | None = None,
    capture: bool = False,
) -> bool:
    """Measure, print, write. Returns whether every skill meets its target, and keeps it on its way through the bytes."""
    from rich.console import Console

    console = Console()
    policy = load_policy(file)
    contract = policy.contract
    curve = read(runs) if runs else None
    pictures: dict[str, str] = {}
    if videos:  # first, so that a machine without OpenGL says so at once
        from policies.skillmimic.film import film

        graph = graph_of(contract)
        for label in contract.skill_labels:
            Parts(console).say(f"{label}: a film")
            gif = videos / f"{label}.gif"
            shown = film(file, graph, label, gif, "capture" if capture else "camera")
            console.print(f"{gif}: {f'run {shown}, the first good one' if shown else 'no good run among those tried'}")
            pictures[label] = _link(gif, card_file)
    with kept(console, file.stem, policy.sha256, episodes, deployed, tables, capture) as parts:
        e = evaluate(file, episodes, deployed, parts, tables, capture)
    show(console, contract, e)
    if report:
        report.write_text(json.dumps(e.as_dict(), indent=1) + "\n")
    if card_file:
        if curve is not None:
            card_file.with_suffix(".svg").write_text(svg(curve))
            pictures["curve"] = card_file.with_suffix(".svg").name
        card_file.write_text(card(contract, e, curve, pictures))
    return all(e.good(label) for label in contract.skill_labels)


def show(console: Any, contract: Contract, e: Evaluation) -> None:
    """Print every number."""
    from rich.table import Table

    table = Table(title=f"{contract.name}: success (95 % confidence), and the paper's measures", box=None)
    for column in ("skill", "where", "success", "Acc.", "E_b m", "E_o m", "E_cg"):
        table.add_column(column)
    for label in contract.skill_labels:
        for way in e.results:
            r = e.results[way][label]
            numbers = (f"{v:.3f}" for v in (r.accuracy, r.body_error, r.ball_error, r.contact_error))
            table.add_row(label, WAYS[way], str(r.success), *numbers)
    console.print(table)
    for text in (table_2(e), table_3(e)):
        console.print(text, markup=False, highlight=False, soft_wrap=True)


def _link(file: Path, card_file: Path | None) -> str:
    return os.path.relpath(file, card_file.parent if card_file else ".")

"""The first half of the paper's Table 3: each skill learned alone, against all of them by one policy.

``python -m policies.skillmimic.mixture g1-ball`` trains a policy for each skill and one for all, every skill on as many
samples here as there. What is trained already is not trained again.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from policies.evaluate import Rate
from policies.skillmimic.ablation import bare, train
from policies.skillmimic.card import SECONDS
from policies.skillmimic.config import TASKS
from policies.skillmimic.evaluate import Result, evaluate_skill
from policies.skillmimic.train import load_graph

FOLDER = Path("runs/mixture")
HEAD = "One skill a policy, or all of them"
NOTE = """Written by `python -m policies.skillmimic.mixture`; do not edit. The first half of the paper's Table 3. As in
`ablation.md` the plan under the policy is the bare clip: no corrections, and nothing presses the ball, so that skills have
to be learned. A policy of all skills has as many samples of each as the policy of that skill alone; networks and settings
are the same. Success as in the policy's card, over 10 s, with 95 % confidence (Wilson) of the pooled episodes. Acc. and E_o
as in the paper's section 6.2. "Nothing learned" is the plan alone."""
Found = Mapping[str, Mapping[str, Sequence[Result]]]  # by skill, by how it was learned, a result a seed


def pooled(results: Sequence[Result]) -> Rate:
    """All seeds' episodes."""
    return Rate(sum(r.success.survived for r in results), sum(r.success.episodes for r in results))


def table(found: Found) -> str:
    """Markdown, a row a skill."""
    ways = list(next(iter(found.values())))
    lines = [f"| skill | {' | '.join(ways)} |", "|---" * (1 + len(ways)) + "|"]
    for skill, by_way in found.items():
        cells = []
        for results in by_way.values():
            acc, ball = (sum(getattr(r, n) for r in results) / len(results) for n in ("accuracy", "ball_error"))
            cells.append(f"{pooled(results)}, Acc. {acc:.3f}, E_o {ball:.3f} m")
        lines.append(f"| `{skill}` | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("task", choices=[name for name, c in TASKS.items() if c.base])
    parser.add_argument("--samples", type=float, default=0.3e6, help="of each skill")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--episodes", type=int, default=100, help="of each seed")
    parser.add_argument("--report", type=Path, help="Markdown to write the table to")
    a = parser.parse_args()
    torch.set_num_threads(1)
    skills = TASKS[a.task].skills
    ways = ("nothing learned", "alone", "all in one policy")
    found: dict[str, dict[str, list[Result]]] = {skill: {way: [] for way in ways} for skill in skills}

    def tell(skill: str, way: str, seed: int, result: Result) -> None:
        found[skill][way].append(result)
        print(f"{skill}, {way}, seed {seed}: {result.success}", flush=True)

    for seed in range(1, a.seeds + 1):
        everything = bare(a.task, seed, a.samples * len(skills))
        mixed = FOLDER / f"{a.task}-all-{seed}"
        train(everything, mixed)
        for skill in skills:
            one = dataclasses.replace(everything, practise=(skill,), samples=a.samples)
            alone = FOLDER / f"{a.task}-{skill}-{seed}"
            train(one, alone)
            for way, folder in zip(ways[1:], (alone, mixed), strict=True):
                graph = load_graph(folder, "last.pt")
                tell(skill, way, seed, evaluate_skill(graph, skill, a.episodes, SECONDS, seed=seed))
            idle = lambda env: torch.zeros(env.num_envs, env.num_actions)  # noqa: E731
            tell(skill, ways[0], seed, evaluate_skill(graph, skill, a.episodes, SECONDS, seed=seed, act=idle))
    text = f"{a.samples / 1e6:g} M samples a skill, {a.seeds} seeds, {a.episodes} episodes each:\n\n{table(found)}\n"
    print(f"\n{text}")
    if a.report:
        a.report.write_text(f"# {HEAD}\n\n{NOTE}\n\n{text}")


if __name__ == "__main__":
    main()

"""The first half of the paper's Table 3: each skill learned alone, against all of them by one policy.

``python -m policies.skillmimic.mixture g1-ball`` trains a policy for each skill and one for all, every skill on as many
samples here as there. What is trained already is not trained again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
import tyro

from policies.skillmimic.ablation import Comparison, bare, pooled, tell, train
from policies.skillmimic.card import SECONDS
from policies.skillmimic.config import TASKS
from policies.skillmimic.env import Env
from policies.skillmimic.evaluate import Result, performed
from policies.skillmimic.train import load_graph

FOLDER = Path("runs/mixture")
HEAD = "One skill a policy, or all of them"
NOTE = """Written by `python -m policies.skillmimic.mixture`; do not edit. The first half of the paper's Table 3. As in
`ablation.md` the plan under the policy is the bare clip: no corrections, and nothing presses the ball, so that skills have
to be learned. A policy of all skills has as many samples of each as the policy of that skill alone; networks and settings
are the same. Success as in the policy's card, over 10 s, with 95 % confidence (Wilson) of the pooled episodes. Acc. and E_o
as in the paper's section 6.2. "Nothing learned" is the plan alone."""
Found = Mapping[str, Mapping[str, Sequence[Result]]]  # by skill, by how it was learned, a result a seed


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
    a = tyro.cli(
        Comparison,
        prog="python -m policies.skillmimic.mixture",
        description="Each skill learned alone, against all of them by one policy.",
    )
    torch.set_num_threads(1)
    skills = TASKS[a.task].skills
    ways = ("nothing learned", "alone", "all in one policy")
    found: dict[str, dict[str, list[Result]]] = {skill: {way: [] for way in ways} for skill in skills}

    def idle(env: Env) -> torch.Tensor:
        return torch.zeros(env.num_envs, env.num_actions)

    for seed in range(1, a.seeds + 1):
        everything = bare(a.task, seed, a.samples * len(skills))
        folder = FOLDER / f"{a.task}-all-{seed}"
        train(everything, folder)
        mixed = load_graph(folder, "last.pt")
        for skill in skills:
            folder = FOLDER / f"{a.task}-{skill}-{seed}"
            train(dataclasses.replace(everything, practise=(skill,), samples=a.samples), folder)
            learned = ((mixed, idle), (load_graph(folder, "last.pt"), None), (mixed, None))
            for way, (graph, act) in zip(ways, learned, strict=True):
                result = performed(graph, skill, a.episodes, SECONDS, seed=seed, act=act).result()
                found[skill][way].append(result)
                print(f"{skill}, {way}, seed {seed}: {result.success}", flush=True)
    text = f"{a.samples / 1e6:g} M samples a skill, {a.seeds} seeds, {a.episodes} episodes each:\n\n{table(found)}\n"
    tell(text, a.report, HEAD, NOTE)


if __name__ == "__main__":
    main()

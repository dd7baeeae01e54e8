"""A run as one HTML file that needs nothing else: no script, no network, light and dark, every name escaped."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sim2real.config import ConfigError
from sim2real.recorder.run import Run
from sim2real.recorder.summary import RecordSummary, summarise
from sim2real.recorder.svg import Frame, bounds, histogram, strips, text, ticks
from sim2real.types import Mode, Sim2realError

LATENESS_EDGES = np.array([0, 20e-6, 50e-6, 100e-6, 200e-6, 500e-6, 1e-3, 2e-3, 5e-3, 20e-3])  # s
SKILL_COLOURS = 8
COLD = 20.0  # deg C: where the colour of a temperature begins

STYLE = """
:root { color-scheme: light dark; --page: #f7f6f3; --card: #ffffff; --ink: #1d1d1b; --soft: #62615b; --line: #e4e2dc;
  --blue: #2a78d6; --target: #b0aea6; --red: #c93636;
  --run: #1a8f62; --hold: #b7791f; --damp: #cf4a1f; --off: #8b8983; }
@media (prefers-color-scheme: dark) { :root { --page: #161615; --card: #20201e; --ink: #f1f0ec; --soft: #a5a39b;
  --line: #383733; --blue: #5c9fea; --target: #74726b; --red: #e66767;
  --run: #1f9d6d; --hold: #b8812c; --damp: #d9582c; --off: #6f6d67; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 28px 20px 60px; max-width: 1180px; background: var(--page); color: var(--ink);
  font: 14px/1.5 system-ui, sans-serif; }
h1 { font-size: 24px; margin: 0; } h2 { font-size: 16px; margin: 34px 0 4px; }
p { margin: 0 0 10px; color: var(--soft); max-width: 80ch; } p.alarm { color: var(--red); font-weight: 600; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 12px; overflow-x: auto; }
.card > svg { min-width: 720px; }
.tiles { display: grid; grid-template-columns: repeat(auto-fill, minmax(250px, 1fr)); gap: 10px; margin-top: 18px; }
.tile { background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 10px 13px; }
.tile b { display: block; font-size: 20px; font-weight: 600; overflow-wrap: anywhere; } .tile.alarm b { color: var(--red); }
.tile span { color: var(--soft); font-size: 12px; overflow-wrap: anywhere; }
.grid-of-joints { display: grid; grid-template-columns: repeat(auto-fill, minmax(330px, 1fr)); gap: 10px; }
figure { margin: 0; background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 8px 8px 2px; }
figcaption { font-size: 12px; display: flex; justify-content: space-between; gap: 8px; padding: 0 4px; }
figcaption span { color: var(--soft); white-space: nowrap; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(330px, 1fr)); gap: 10px; }
svg { display: block; width: 100%; height: auto; font: 10.5px system-ui, sans-serif; }
svg text { fill: var(--ink); } .tick { fill: var(--soft); font-variant-numeric: tabular-nums; }
.end { text-anchor: end; } .mid { text-anchor: middle; }
.grid, .rule { stroke: var(--line); stroke-width: 1; } .rule { stroke: var(--card); } .axis { stroke: var(--soft); }
.measured, .commanded, .load { fill: none; stroke-linejoin: round; stroke-width: 5.5; stroke: var(--blue); }
.commanded { stroke: var(--target); stroke-width: 7; } .limit { stroke: var(--red); stroke-dasharray: 3 3; }
.dot { fill: var(--c); opacity: 0.5; } .bar { fill: var(--blue); } image { image-rendering: pixelated; }
.band text { fill: #fff; font-weight: 600; } .mark { stroke: var(--red); stroke-width: 2; }
.RUN { fill: var(--run); } .HOLD { fill: var(--hold); } .DAMP { fill: var(--damp); } .OFF, .quiet { fill: var(--off); }
.s0, .key .s0 { --c: #2a78d6; } .s1 { --c: #12805c; } .s2 { --c: #8a5fd0; } .s3 { --c: #b8621b; } .s4 { --c: #b83280; }
.s5 { --c: #557a1f; } .s6 { --c: #14808f; } .s7 { --c: #a0522d; }
.band rect.skill { fill: var(--c); } path.load { stroke: var(--c); }
.key { display: flex; flex-wrap: wrap; gap: 4px 16px; font-size: 12px; color: var(--soft); margin: 0 0 8px; }
.key i { display: inline-block; width: 14px; height: 4px; border-radius: 2px; margin-right: 6px; vertical-align: middle;
  background: var(--c, var(--blue)); }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: 3px 10px; border-bottom: 1px solid var(--line); white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } th { color: var(--soft); font-weight: 500; }
summary { cursor: pointer; color: var(--soft); margin: 26px 0 8px; }
@media print { body { max-width: none; } figure, .card { break-inside: avoid; } }
"""
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"  # whatever slipped through could not run


def write_plot(run: Run, output: Path | str | None = None) -> Path:
    """Write the report (default: beside the record, ``.html``) and return its path. Raises Sim2realError."""
    output = Path(output) if output else run.path.with_suffix(".html")
    try:
        output.write_text(page(run), encoding="utf-8")
    except OSError as error:
        raise Sim2realError(f"{output}: cannot write: {error.strerror}; name another file with -o") from None
    return output


def page(run: Run) -> str:
    """The HTML of a run."""
    summary = summarise(run)
    with np.errstate(all="ignore"):
        parts = [
            _header(run, summary),
            _tiles(summary),
            _section(
                "Timeline",
                "What the gate let through, what the pilot performed, and when something was wrong.",
                f'<div class="card">{_timeline(run, summary)}</div>',
            ),
            _section(
                "Joint positions",
                "rad, commanded by the gate and measured. Figures are the root mean square of the difference while armed.",
                '<div class="key"><span><i style="background:var(--target)"></i>commanded</span><span><i></i>measured</span>'
                f'<span><i style="background:var(--red)"></i>range</span></div><div class="grid-of-joints">{_positions(run, summary)}</div>',
            ),
            *_object(run, summary),
            *_strips(run, summary),
            _section(
                "Lateness",
                "How late each tick woke up; counts on a logarithmic scale. In lockstep nothing is ever late.",
                f'<div class="pair">{_lateness(run)}</div>',
            ),
            _section("Bus load", "Share of each wire's time that frames took.", _loads(run, summary)),
            _table(summary),
        ]
    title = text(f"{summary.run.get('robot', 'run')} {summary.run.get('started', '')}")
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta http-equiv="Content-Security-Policy" content="{text(POLICY)}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{STYLE}</style></head><body>\n" + "\n".join(parts) + "\n</body></html>\n"
    )


def _section(title: str, explanation: str, body: str) -> str:
    return f"<section><h2>{text(title)}</h2><p>{text(explanation)}</p>{body}</section>"


def _header(run: Run, summary: RecordSummary) -> str:
    about = summary.run
    parts = [about.get("started"), about.get("clock"), about.get("wiring"), about.get("revision"), run.path.name]
    line = " · ".join(text(p) for p in parts if p)
    faults = "".join(f'<p class="alarm">{text(f)}</p>' for f in summary.faults)
    notes = "".join(f"<p>{text(n)}</p>" for n in [*summary.notes, summary.recording_stopped] if n)
    return f"<header><h1>{text(about.get('robot', 'A run'))}</h1><p>{line}</p>{faults}{notes}</header>"


def degrees(value: float) -> str:
    """A temperature, or that there is none: not every motor has a thermometer."""
    return f"{value:.0f} °C" if np.isfinite(value) else "not measured"


def _tiles(s: RecordSummary) -> str:
    hot = max(s.joints, key=lambda j: np.nan_to_num(j.temperature_max, nan=-np.inf))
    stretched = max(s.joints, key=lambda j: j.torque_share or 0.0)
    margins = [j for j in s.joints if j.margin is not None]
    close = min(margins, key=lambda j: j.margin) if margins else None  # type: ignore[arg-type, return-value]
    load = max(s.buses, key=lambda b: b.load_max)
    lost = sum(b.lost + b.rejected for b in s.buses)
    tiles = [
        ("duration", f"{s.duration:.1f} s", f"{s.ticks} ticks, {s.policy_ticks} of the policy", False),
        ("faults", str(len(s.faults)) if s.faults else "none", s.faults[0] if s.faults else "", bool(s.faults)),
        (
            "late ticks",
            str(s.ticks_late + s.policy_ticks_late),
            f"p99 {s.timing['lateness']['p99'] * 1e6:.0f} µs",
            False,
        ),
        ("refused switches", str(s.refused_switches), "", False),
        ("hottest", degrees(hot.temperature_max), hot.name, False),
        ("torque", f"{stretched.torque_share:.0%}" if stretched.torque_share else "?", stretched.name, False),
        ("closest to a limit", f"{close.margin:.3f} rad" if close else "?", close.name if close else "", False),
        ("bus load", f"{load.load_max:.0%}", f"{load.name}; {lost} frames lost or rejected", False),
    ]
    return '<div class="tiles">' + "".join(
        f'<div class="tile{" alarm" if alarm else ""}"><span>{text(name)}</span><b>{text(value)}</b>'
        f"<span>{text(note)}</span></div>"
        for name, value, note, alarm in tiles
    ) + "</div>"  # fmt: skip


def _timeline(run: Run, summary: RecordSummary) -> str:
    frame = Frame((0.0, max(run.duration, 1e-6)), (0, 1), 1000, 92, 50)
    out = []
    for row, (name, periods) in enumerate((("mode", summary.modes), ("skill", summary.skills))):
        y = 2 + 30 * row
        out.append(f'<text class="tick end" x="44" y="{y + 17}">{name}</text>')
        fault = ""
        for p in periods:
            x, end = frame.to_x(p.start), frame.to_x(p.end)
            css = p.name if name == "mode" and p.name in Mode.__members__ else "quiet"
            if name == "skill" and p.name in run.labels:
                css = f"skill s{run.labels.index(p.name) % SKILL_COLOURS}"
            tip = f"{p.name} {p.start:.2f} to {p.end:.2f} s {p.fault} {p.joint}".strip()
            label = p.name if end - x > 7 * len(p.name) + 6 else ""
            out.append(
                f'<g class="band"><title>{text(tip)}</title><rect class="{css}" x="{x:.1f}" y="{y}"'
                f' width="{max(end - x - 1, 1):.1f}" height="26" rx="4"/>'
                f'<text x="{x + 6:.1f}" y="{y + 17}">{text(label)}</text></g>'
            )
            if p.fault and p.fault != fault:
                out.append(f'<path class="mark" d="M{x:.1f} {y}v64"/>')
                side, gap = ("end", -5) if x > 700 else ("", 5)
                out.append(f'<text class="{side}" x="{x + gap:.1f}" y="71">{text(p.fault)} {text(p.joint)}</text>')
            fault = p.fault
    for t in ticks(*frame.x, 10):
        out.append(f'<text class="tick mid" x="{frame.to_x(t):.1f}" y="88">{t:g} s</text>')
    return frame.svg(*out, label="modes, skills and faults over time")


def _positions(run: Run, summary: RecordSummary) -> str:
    try:
        ranges = [j.position for j in run.robot.joints]
    except ConfigError:
        ranges = [(-np.inf, np.inf)] * len(run.joints)
    armed = run.tick["mode"] <= Mode.HOLD
    out = []
    for i, (joint, limits) in enumerate(zip(summary.joints, ranges, strict=True)):
        measured = run.tick["state.joint_pos"][:, i]
        commanded = np.where(armed & (run.tick["command.kp"][:, i] > 0), run.tick["command.joint_pos"][:, i], np.nan)
        frame = Frame((0.0, max(run.duration, 1e-6)), bounds(measured, commanded, least=0.05), 340, 120)
        drawing = frame.svg(
            frame.grid(4),
            *(frame.level(limit, "limit") for limit in limits),
            frame.line(run.time, commanded, "commanded"),
            frame.line(run.time, measured, "measured"),
            label=f"{joint.name}: commanded and measured position over time",
        )
        rmse = "" if joint.tracking_rmse is None else f"{joint.tracking_rmse:.3f} rad"
        out.append(f"<figure><figcaption>{text(joint.name)}<span>{rmse}</span></figcaption>{drawing}</figure>")
    return "".join(out)


def _object(run: Run, summary: RecordSummary) -> list[str]:
    """Where the object was believed to be, and how long ago it was seen."""
    if summary.object is None:
        return []
    try:
        limit = run.robot.safety.object_age
    except ConfigError:
        limit = np.inf
    seen, time = run.object, run.object["time"] - run.start
    x = (0.0, max(run.duration, 1e-6))
    fresh = np.append(True, seen["sighting.time"][1:] != seen["sighting.time"][:-1])
    sighted = np.where(fresh[:, None], seen["sighting.position_in_base"], np.nan)
    taken = seen["sighting.time"] - run.start
    place = Frame(x, bounds(seen["position_in_base"], least=0.2), 1000, 190)
    age = Frame(x, (0.0, bounds(np.array([0.1]), seen["age"])[1]), 1000, 110)
    axes, colours = range(3), ("s0", "s1", "s3")
    dots = "".join(
        f'<circle class="dot {colours[i]}" cx="{place.to_x(a):.1f}" cy="{place.to_y(b):.1f}" r="1.3"/>'
        for i in axes
        for a, b in zip(taken.tolist(), sighted[:, i].tolist(), strict=True)
        if np.isfinite(b) and place.y[0] <= b <= place.y[1]
    )
    lines = [place.line(time, seen["position_in_base"][:, i], f"load {colours[i]}", 2) for i in axes]
    lines = [line.replace("<path ", '<path stroke-width="3" ') for line in lines]
    key = "".join(f'<span><i class="{colours[i]}"></i>{name}, m</span>' for i, name in enumerate("xyz"))
    drawing = place.svg(place.grid(10, 4), dots, *lines, label="position of the object in the base over time")
    aged = age.svg(
        age.grid(10, 3), age.level(limit, "limit"), age.line(time, seen["age"], "measured"),
        label="age of the object's estimate over time",
    )  # fmt: skip
    return [
        _section(
            "Object",
            f"Believed position in the base (lines) and sightings (dots, where the base was then); below, s since it was seen. "
            f"{summary.object.used} of {summary.object.sightings} sightings were used.",
            f'<div class="key">{key}</div><div class="card">{drawing}{aged}</div>',
        )
    ]


def _strips(run: Run, summary: RecordSummary) -> list[str]:
    """Torque and temperature of every joint as shares of what it may."""
    try:
        robot = run.robot
    except ConfigError:
        return []
    torque = np.abs(run.tick["state.joint_torque"]) / robot.torque_max
    limit = robot.safety.temperature
    heat = (run.tick["state.joint_temperature"] - COLD) / (limit - COLD)
    return [
        _section(
            "Torque",
            "Measured torque as a share of the joint's limit: clear is none, full blue the limit, red above it.",
            '<div class="card">'
            + strips(torque, run.time, run.joints, [f"{j.torque_max:.1f} N m" for j in summary.joints], "torque shares")
            + "</div>",
        ),
        _section(
            "Temperature",
            f"Motor temperature: clear is {COLD:.0f} °C, full blue {limit:.0f} °C where the gate trips, red above it.",
            '<div class="card">'
            + strips(heat, run.time, run.joints, [degrees(j.temperature_max) for j in summary.joints], "temperatures")
            + "</div>",
        ),
    ]


def _lateness(run: Run) -> str:
    out = []
    for name, records in (("guardian", run.tick), ("pilot", run.pilot)):
        if len(records):
            late = records["timing.lateness"]
            drawing = histogram(late, LATENESS_EDGES, f"lateness of the {name}")
            out.append(f"<figure><figcaption>{name}<span>{len(records)} ticks</span></figcaption>{drawing}</figure>")
    return "".join(out)


def _loads(run: Run, summary: RecordSummary) -> str:
    load = run.tick["bus.load"]
    frame = Frame((0.0, max(run.duration, 1e-6)), (0.0, bounds(load, least=0.1)[1]), 1000, 190)
    lines = [
        frame.line(run.time, load[:, i], f"load s{i % SKILL_COLOURS}", 2).replace("<path ", '<path stroke-width="3" ')
        for i in range(len(run.buses))
    ]
    key = "".join(
        f'<span><i class="s{i % SKILL_COLOURS}"></i>{text(b.name)}: {b.load_mean:.0%} mean, {b.lost} lost,'
        f" {b.rejected} rejected</span>"
        for i, b in enumerate(summary.buses)
    )
    drawing = frame.svg(frame.grid(10, 4), *lines, label="load of each bus over time")
    return f'<div class="key">{key}</div><div class="card">{drawing}</div>'


def _table(summary: RecordSummary) -> str:
    def number(value: float | None, form: str) -> str:
        return "" if value is None or not np.isfinite(value) else format(value, form)

    rows = "".join(
        f"<tr><td>{text(j.name)}</td><td>{number(j.tracking_rmse, '.4f')}</td><td>{number(j.margin, '.3f')}</td>"
        f"<td>{number(j.torque_max, '.1f')}</td><td>{number(j.torque_share, '.0%')}</td>"
        f"<td>{number(j.temperature_max, '.0f')}</td></tr>"
        for j in summary.joints
    )
    head = "".join(
        f"<th>{h}</th>" for h in ("joint", "tracking rad", "margin rad", "torque N m", "of limit", "temperature °C")
    )
    run = "".join(f"<tr><td>{text(k)}</td><td>{text(v[:300])}</td></tr>" for k, v in summary.run.items())
    return (
        f'<details><summary>The same in numbers</summary><div class="card"><table><tr>{head}</tr>{rows}</table></div>'
        f'</details><details><summary>About the run</summary><div class="card"><table>{run}</table></div></details>'
    )

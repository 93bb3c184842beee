"""Tables of the pages, rendered from results/ when the site is built: a hook of MkDocs.

A page asks for one of `TABLES` by its name in a comment: ``<!-- table: eval -->``.
"""

import json
import re
from collections.abc import Iterable, Iterator
from math import exp, inf, log
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parents[1] / "results"
MARKER = re.compile(r"^<!-- table: (\w+) -->$", re.M)
QUANTITIES = 3  # side by side: more do not fit on the page
BATCH = 512


def read(name: str, folder: Path = RESULTS) -> dict[str, dict[str, Any]]:
    """Robot -> record of every ``NAME_ROBOT.json``."""
    paths = sorted(folder.glob(f"{name}_*.json"))
    return {p.stem.removeprefix(f"{name}_"): json.loads(p.read_text()) for p in paths}


def one(name: str, folder: Path) -> dict[str, Any] | None:
    """The record of ``NAME.json``, if it is there."""
    path = folder / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else None


def rows(cells: Iterable[Iterable[str]]) -> str:
    """A table of Markdown, header first."""
    header, *body = [list(row) for row in cells]
    lines = [header, ["---"] * len(header), *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def number(value: float | None) -> str:
    """Two digits; what is not finite diverges."""
    if value is None:
        return "-"
    if 99.5 <= abs(value) < 1e6:
        return f"{float(f'{value:.2g}'):,.0f}"  # no power of ten
    return f"{value:.2g}" if abs(value) < float("inf") else "diverges"


def made_by(record: dict[str, Any]) -> str:
    """The line under a table: how to make it again."""
    machine = record["machine"]
    device = machine.get("device", "cpu")
    where = machine["processor"] if device == "cpu" else device
    threads = f"{machine['threads']} thread{'s' * (machine['threads'] != 1)}"
    return (
        f"`{record['command']}`, commit {record['commit'][:7]}, seed {record['seed']}, "
        f"{where}, {threads}, MuJoCo {machine['mujoco']}."
    )


def with_sources(cells: list[list[str]], records: Iterable[dict[str, Any]]) -> str:
    """A table, and how each of its records was made; nothing without a line."""
    return "\n\n".join((rows(cells), *map(made_by, records))) if cells[1:] else ""


def error_table(entries: list[dict[str, Any]], rates: dict[str, float]) -> str:
    """Rows of one case and horizon: mean of up to three quantities, and the rate."""
    names = dict.fromkeys((entry["name"], entry["kind"]) for entry in entries)
    quantities = dict.fromkeys((e["quantity"], e["unit"]) for e in entries)
    shown = list(quantities)[:QUANTITIES]
    mean = {(e["name"], e["quantity"]): e["mean"] for e in entries}
    head = [f"{quantity} ({unit})" for quantity, unit in shown]
    table = [["name", "kind", *head, *(["steps/s"] if rates else [])]]
    for name, kind in names:
        line = [
            name,
            kind,
            *(number(mean.get((name, quantity))) for quantity, _ in shown),
        ]
        table.append(
            line + ([f"{rates[name]:,.0f}" if name in rates else "-"] if rates else [])
        )
    return rows(table)


def eval_tables(folder: Path = RESULTS) -> str:
    """Every robot: its cases at their longest horizon."""
    parts = []
    for robot, record in read("eval", folder).items():
        entries = record["results"]["errors"]
        parts.append(f"### {robot}")
        for case in dict.fromkeys(entry["case"] for entry in entries):
            own = [entry for entry in entries if entry["case"] == case]
            steps = max(entry["steps"] for entry in own)
            longest = [entry for entry in own if entry["steps"] == steps]
            parts += [
                f"Case {case}, {steps} steps, mean error:",
                error_table(longest, {}),
            ]
        parts.append(made_by(record))
    return "\n\n".join(parts)


def bench_tables(folder: Path = RESULTS) -> str:
    """Every robot: error and control steps per second."""
    parts = []
    for robot, record in read("bench", folder).items():
        results = record["results"]
        batches = {row["batch"] for row in results["rates"]}
        batch = BATCH if BATCH in batches else max(batches)
        rates = {
            r["name"]: r["steps_per_s"] for r in results["rates"] if r["batch"] == batch
        }
        about = f"Batch {batch}, {results['steps']} steps, mean error:"
        parts += [f"### {robot}", about, error_table(results["errors"], rates)]
        parts.append(made_by(record))
    return "\n\n".join(parts)


def gallery_table(folder: Path = RESULTS) -> str:
    """Shipped models: the first error of their longest test, and their rates."""
    table = [["model", "kind", "quantity, steps", "mean error", "steps/s", "compiled"]]
    kinds = "learned", "hybrid", "analytic"
    records, rated = read("eval", folder), read("bench", folder)
    for robot, record in records.items():
        rates = rated[robot]["results"]["rates"] if robot in rated else []
        rates = {x["name"]: x["steps_per_s"] for x in rates if x["batch"] == BATCH}
        errors = record["results"]["errors"]
        first = errors[0]["case"], errors[0]["quantity"]
        own = [x for x in errors if (x["case"], x["quantity"]) == first]
        steps = max(entry["steps"] for entry in own)
        for entry in own:
            if entry["kind"] not in kinds or entry["steps"] != steps:
                continue
            name = entry["name"].replace("analytic", f"analytic, {robot}")
            mean = f"{number(entry['mean'])} {entry['unit']}"
            line = [name, entry["kind"], f"{first[1]}, {steps}", mean]
            both = (rates.get(entry["name"] + way) for way in ("", ", compiled"))
            table.append([*line, *("-" if x is None else f"{x:,.0f}" for x in both)])
    return rows(table) if records else ""


def network_off_table(folder: Path = RESULTS) -> str:
    """Hybrids with their network and without, means over all terrains."""
    record = one("network_off", folder)
    if record is None:
        return ""
    found: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in record["results"]:
        key = row["model"], row["drive"], row["quantity"]
        found.setdefault(key, []).append(row)
    table = [["hybrid", "motion", "quantity", "with network (rad)", "without (rad)"]]
    for key, same in found.items():
        pairs = ([row[way]["mean"] for row in same] for way in ("with", "without"))
        table.append([*key, *(f"{sum(x) / len(x):.4f}" for x in pairs)])
    return with_sources(table, [record])


def stability_tables(folder: Path = RESULTS) -> str:
    """One row per case, one column per model; then what failed, and by how much."""
    records = read("stability", folder).values()
    found = {record["results"]["model"]: record["results"] for record in records}
    tried = {
        model: {case: trial for case, trial in results.items() if is_trial(trial)}
        for model, results in found.items()
    }
    cases = dict.fromkeys(case for trials in tried.values() for case in trials)
    words = {True: "pass", False: "**fail**", None: "-"}
    table = [["case", *(f"{model}, {x['kind']}" for model, x in found.items())]]
    failed = [["model", "case", "metric", "model's", "MuJoCo's", "tolerance"]]
    for case in cases:
        verdicts = [trials.get(case, {}).get("passes") for trials in tried.values()]
        table.append([case, *(words[verdict] for verdict in verdicts)])
        for model, trials in tried.items():
            failed += [[model, case, *line] for line in beyond(trials.get(case, {}))]
    shown = [rows(found) for found in (table, failed) if found[1:]]
    return "\n\n".join((*shown, *map(made_by, records)))


def is_trial(value: Any) -> bool:
    """Whether it is what a hard case found."""
    return isinstance(value, dict) and "passes" in value


def beyond(trial: dict[str, Any]) -> Iterator[list[str]]:
    """The metrics of a hard case that are beyond their tolerance, with MuJoCo's."""
    for metric, limit in trial.get("tolerances", {}).items():
        value = trial["tested"].get(metric)
        if value is not None and not value <= limit:
            exact = number(trial["ground_truth"].get(metric))
            yield [metric, number(value), exact, number(limit)]


def env_table(folder: Path = RESULTS) -> str:
    """One row per task and dynamics: control steps per second, seconds to compile."""
    record = one("env_rate", folder)
    if record is None:
        return ""
    tasks = record["results"]["tasks"]
    batches = sorted({row["num_envs"] for found in tasks.values() for row in found})
    table = [["task", "dynamics", *(f"{batch} envs" for batch in batches)]]
    table[0] += ["first compiled step (s)", "with torch's cache (s)"]
    for task, found in tasks.items():
        for way in dict.fromkeys((row["dynamics"], row["compiled"]) for row in found):
            same = [x for x in found if (x["dynamics"], x["compiled"]) == way]
            speeds = [rate(row["steps_per_s"]) for row in same]
            name, compiled = way
            keys = ("cold_s", "warm_s") if compiled else ()
            times = [f"{same[0][key]:.0f}" for key in keys] or ["", ""]
            shown = f"{name}, compiled" if compiled else name
            table.append([task, shown, *speeds, *times])
    return f"{rows(table)}\n\n{made_by(record)}"


def kinematics_table(folder: Path = RESULTS) -> str:
    """A row per robot, library and way to run it."""
    record = one("kinematics_libraries", folder)
    if record is None:
        return ""
    table = [["robot", "library", "run", "positions (ms)", "with velocities (ms)"]]
    for row in record["results"]:
        times = (row[key] for key in ("positions_ms", "with_velocities_ms"))
        way = "compiled" if row["compiled"] else "eager"
        table.append([row["scene"], row["library"], way, *map(number, times)])
    return f"{rows(table)}\n\n{made_by(record)}"


def returns_tables(pattern: str, folder: Path) -> str:
    """Returns of shipped policies in each dynamics."""
    table = [["task, policy", "dynamics", "kind", "return", "difference (%)"]]
    records = [
        json.loads(path.read_text())
        for path in sorted(folder.glob(f"transfer_{pattern}.json"))
    ]
    for record in records:
        results = record["results"]
        policy = results["policy"].removeprefix("runs/")
        for row in results["returns"]:
            line = f"{results['task']}, {policy}", row["dynamics"], row["kind"]
            half = f"{100.0 * row['difference_interval']:.2g}"
            share = f"{100.0 * row['difference']:.2g} ± {half}"
            table.append([*line, f"{row['mean']:,.4g}", share])
    return with_sources(table, records)


def transfer_table(folder: Path = RESULTS) -> str:
    """Returns of the policies of franka/reach_osc in each dynamics."""
    return returns_tables("franka_reach_osc*", folder)


def returns_table(folder: Path = RESULTS) -> str:
    """Returns of the shipped policies of ant/run, ant/spin and franka/reach."""
    patterns = "ant_run*", "ant_spin", "franka_reach"
    found = (returns_tables(x, folder) for x in patterns)
    return "\n\n".join(x for x in found if x)


def gpu_rates_table(folder: Path = RESULTS) -> str:
    """Millions of control steps per second: a row per model and mode, a column per size."""
    found: dict[tuple[str, ...], dict[int, float]] = {}
    records = [one(f"gpu/{name}", folder) for name in ("b_rates", "c_mjx_rates")]
    records = [record for record in records if record is not None]
    for record in records:
        for item, values in record["results"]["items"].items():
            *what, size = item.split(", ")
            if "steps_per_s" not in values or not size.isdigit():
                continue
            model, *mode = what
            name = model.removeprefix("MJX ").removesuffix(" streaming")
            row = found.setdefault((name, *(mode or ["MJX"])), {})
            row[int(size)] = values["steps_per_s"] / 1e6
    sizes = sorted({size for row in found.values() for size in row})
    table = [["model or task", "run as", *(f"{size:,}" for size in sizes)]]
    for key, row in sorted(found.items()):
        table.append([*key, *(number(row.get(size)) for size in sizes)])
    return "\n\n".join((rows(table), *map(made_by, records))) if records else ""


def gpu_errors_table(folder: Path = RESULTS) -> str:
    """Mean errors of shipped models on CPU and GPU, in float32 and with bf16 inside."""
    record = one("gpu/a_correctness", folder)
    if record is None:
        return ""
    table = [["model", "quantity", "CPU", "GPU", "GPU, bf16 inside"]]
    for name, found in record["results"]["items"].items():
        for quantity in found.get("float32", {}):
            keys = ("cpu_float32", "float32", "bf16_inside")
            cells = (f"{found[key][quantity]:.3g}" for key in keys)
            table.append([name.removeprefix("model "), quantity, *cells])
    return f"{rows(table)}\n\n{made_by(record)}"


def state_dtype_table(folder: Path = RESULTS) -> str:
    """Errors and times of shipped models with states in float64 and in float32."""
    record = one("state_dtype", folder)
    if record is None:
        return ""
    head = ["float64", "float32", "float64 (us)", "float32 (us)"]
    table = [["model", "quantity, steps", *head]]
    for model, row in record["results"].items():
        for quantity, error in row["float64"].items():
            errors = f"{error:.3g}", f"{row['float32'][quantity]:.3g}"
            times = (f"{row[key]:.1f}" for key in ("float64_us", "float32_us"))
            table.append([model, f"{quantity}, {row['steps']}", *errors, *times])
    return f"{rows(table)}\n\n{made_by(record)}"


UNTRUSTED = "untrusted_before", "untrusted_after"


def of_hidden(errors: dict[str, Any]) -> dict[str, float]:
    """Means by what the tables show: a base's position, and the last or mean joint.

    The base's orientation is shown where there are no joints.
    """
    base = {k: v["mean"] for k, v in errors.items() if k.startswith("base_")}
    joints = [v["mean"] for k, v in errors.items() if k not in base]
    shown = {"base_position (m)": base["base_position"]} if base else {}
    if not joints:
        return shown | {"base_orientation (rad)": base["base_orientation"]}
    if len(joints) > 2:
        return shown | {"the joints (rad)": sum(joints) / len(joints)}
    return shown | {f"{list(errors)[-1]} (rad)": joints[-1]}


def hidden_parameters_tables(folder: Path = RESULTS) -> str:
    """Error of every robot against the length of the history, and by region."""
    parts = []
    for robot, record in read("hidden_parameters", folder).items():
        found = {
            (r["region"], r["name"], r["history"]): r
            for r in record["results"]["errors"]
        }
        names = dict.fromkeys(name for _, name, _ in found)
        lengths = sorted({length for *_, length in found})
        title = robot.replace("_changing", ", the shipped model")
        title = title.replace("_others", ", a GRU and a hybrid")
        parts.append(f"### {title}")
        for steps in ("20", "100"):
            kept = {k: of_hidden(r["errors"][steps]) for k, r in found.items()}
            for quantity in next(iter(kept.values())):
                table = [["steps of history", *map(str, lengths)]]
                for name in names:
                    cells = (kept.get(("inside", name, n)) for n in lengths)
                    means = ("-" if x is None else number(x[quantity]) for x in cells)
                    table.append([name, *means])
                parts += [f"Mean error of {quantity} over {steps} steps:", rows(table)]
        regions = dict.fromkeys(region for region, *_ in found)
        first = next(iter(next(iter(kept.values()))))  # over 100 steps
        table = [["parameters, after 20 steps", *regions, "time per robot (ms)"]]
        for name in names:
            means = (number(kept[region, name, 20][first]) for region in regions)
            alone = found["inside", next(iter(names)), 0]  # nominal MuJoCo
            alone = found.get(("inside", name, 0), alone)
            spent = found["inside", name, 20]["seconds"] - alone["seconds"]
            table.append([name, *means, number(1e3 * max(spent, 0.0))])
        about = f"Mean error of {first} over 100 steps, and time for the history:"
        parts += [about, rows(table)]
        head = ["what changes", "model", "before", "after", "steps until it is back"]
        head += ["untrusted before", "after"]
        table = [["times", *head]]
        for row in record["results"]["changes"]:
            errors = number(row["before"]), number(row["first"])
            back = row["steps_until_back"]
            times = f"{row['factor']:.2f}", row["parameter"], row["name"]
            lost = (f"{row[key]:.1%}" for key in UNTRUSTED)
            table.append([*times, *errors, "-" if back is None else str(back), *lost])
        parts += ["Median error of one step when a parameter changes:", rows(table)]
        table = [["512 envs", "control steps per second", "history (KiB per env)"]]
        for row in record["results"]["rates"]:
            # records of before name the band alone
            name = row.get("name") or f"transformer 2x64, band {row['band']}"
            kib = row.get("history_kib_per_env", row.get("ring_kib_per_env"))
            table.append([name, f"{row['steps_per_s']:,.0f}", f"{kib:.3g}"])
        parts += ["Rates, not compiled:", rows(table)]
        parts.append(made_by(record))
    return "\n\n".join(parts)


SOURCES = {"shared": "MuJoCo Menagerie"}
"""Sources whose folder has another name."""


def robots_table(folder: Path = RESULTS) -> str:
    """Third-party robots: how many load, each that does, and why others do not."""
    record = one("robots_that_load", folder)
    if record is None:
        return ""
    found, refused = [], []
    for row in record["results"]:
        found.append(row | {"source": SOURCES.get(row["source"], row["source"])})
    head = ["robot", "points", "beyond them", "from mj_step", "dropped", "speed"]
    tables: dict[str, list[list[str]]] = {}
    for row in found:
        name, source = row["robot"], row["source"]
        if not row["loads"]:
            refused.append(f"- {source}: {name}: {row['why'].partition(': ')[2]}.")
            continue
        table = tables.setdefault(source, [head])
        points, error = row["contact_points"], 1e3 * row["contact_error_m"]
        speed = number(row["speed_p99"].get("rad_per_s"))
        share = f"{100.0 * row['dropped']:.0f}%"
        same = number(row["difference"])
        name = name.replace("_", "_<wbr>")  # where a long one may be broken
        table.append([name, str(points), f"{error:.1f} mm", same, share, speed])
    loads = [["source", "robots", "load"]]
    for source in dict.fromkeys(row["source"] for row in found):
        own = [row["loads"] for row in found if row["source"] == source]
        loads.append([source, str(len(own)), str(sum(own))])
    loads.append(["all", str(len(found)), str(len(found) - len(refused))])
    why = "Refused:\n\n" + "\n".join(refused) if refused else ""
    each = (f"**{source}**\n\n{rows(table)}" for source, table in tables.items())
    return "\n\n".join((rows(loads), *each, why, made_by(record)))


def minutes_to(curve: list[dict[str, float]], wanted: float) -> str:
    """Until a policy first earned so much; of old records, where no time is, nothing."""
    times = [x["seconds"] for x in curve if x["return"] >= wanted and "seconds" in x]
    return f"{times[0] / 60:.1f}" if times else "-"


def _task_and_seed(how: dict[str, Any]) -> str:
    return f"{how['name']}, seed {how['seed']}" if how["seed"] else how["name"]


def policies_table(folder: Path = RESULTS) -> str:
    """Policies that learned in a model alone, and in MuJoCo: returns, frames, minutes.

    The minutes to 90% are those until 0.9 of the last return in MuJoCo, at equal actions.
    """
    head = ["task", "learned in", "robot's frames", "minutes", "to 90%"]
    # rivals of several models are one
    lines: dict[tuple[str, str, str], list[str]] = {}
    records = [record for _, record in sorted(read("policies", folder).items())]
    for record in records:
        found, how = record["results"], record["results"]["configuration"]
        spent = {k: f"{sum(v.values()) / 60:.0f}" for k, v in found["seconds"].items()}
        few, most = (found[way][-1]["robot_frames"] for way in ("model", "mujoco"))
        promised = spread(found["returns"]["learned in the model, in the model"])
        wanted = 0.9 * found["returns"]["learned in MuJoCo"]["mean"]
        ours, theirs = (
            [spent[way], minutes_to(found[way], wanted)] for way in ("model", "mujoco")
        )
        network, none = f"model, {how['network']}", ["-", "-"]
        task = _task_and_seed(how)
        for name, way, frames, minutes, in_model in (
            ("the model, in MuJoCo", network, few, ours, promised),
            ("MuJoCo", "MuJoCo", most, theirs, "-"),
            ("MuJoCo, the rule of trust", "MuJoCo, rule of trust", most, none, "-"),
            ("MuJoCo, the model's robot frames", "MuJoCo", few, none, "-"),
        ):
            if (returns := found["returns"].get(f"learned in {name}")) is not None:
                about = task, way, f"{frames:,}"
                line = [*about, *minutes, spread(returns), in_model]
                if about not in lines or lines[about][4] == "-":  # without times
                    lines[about] = line
    columns = [*head, "return in MuJoCo", "in the model"]
    return with_sources([columns, *lines.values()], records)


def policy_curves_table(folder: Path = RESULTS) -> str:
    """The same policies on their way: return in MuJoCo after each fifth of the actions."""
    parts = 5
    table = [["task", "learned in", *(f"{i} of {parts}" for i in range(1, parts + 1))]]
    for _, record in sorted(read("policies", folder).items()):
        found, how = record["results"], record["results"]["configuration"]
        for way, name in (("model", f"model, {how['network']}"), ("mujoco", "MuJoCo")):
            count = len(found[way])
            places = (max(1, count * i // parts) - 1 for i in range(1, parts + 1))
            earned = (f"{found[way][i]['return']:,.0f}" for i in places)
            line = [_task_and_seed(how), name, *earned]
            if line not in table:  # rivals of several models are one
                table.append(line)
    return rows(table) if table[1:] else ""


def time_to_policy_table(folder: Path = RESULTS) -> str:
    """What PPO took in each dynamics until its policy had earned enough in MuJoCo."""
    table = [["task, seed", "learned in", "return wanted", "minutes to it"]]
    table[0] += ["minutes in all", "last return", "promised"]
    records = read("time_to_policy", folder).values()
    for record in records:
        found = record["results"]
        for name, curve in found["curves"].items():
            taken = found["seconds"][name]
            to_it = "not reached" if taken is None else f"{taken / 60:.1f}"
            how, last = found["configuration"], curve[-1]
            about = f"{how['task']}, {how['seed']}", name, f"{found['wanted']:,.0f}"
            returns = (last.get(key) for key in ("return", "promised"))
            shown = ("not measured" if x is None else f"{x:,.0f}" for x in returns)
            table.append([*about, to_it, f"{last['seconds'] / 60:.1f}", *shown])
    return with_sources(table, records)


def unmet_policies_table(folder: Path = RESULTS) -> str:
    """Models by their return differences for policies that learned elsewhere."""
    table = [["task", "model", "policies", "mean, worst (%)", "of the best (%)"]]
    records = read("unmet_policies", folder).values()
    for record in records:
        found = record["results"]
        for model in found["models"]:
            pairs = ("mean", "worst"), ("mean_of_best", "worst_of_best")
            shares = (
                ", ".join(f"{100.0 * model[x]:.1f}" for x in pair) for pair in pairs
            )
            about = found["task"], f"{model['model']}, {model['kind']}"
            table.append([*about, str(model["policies"]), *shares])
    return with_sources(table, records)


def percent(share: float) -> str:
    """With its sign and one digit after the point, or one digit where that is zero."""
    return f"{100.0 * share:{'+.1f' if abs(share) >= 5e-4 else '+.1g'}}"


def own_policies_table(folder: Path = RESULTS) -> str:
    """Models by the returns of policies that learned in them alone."""
    head = "task", "model", "seeds", "return in MuJoCo, promised"
    table = [[*head, "difference, largest (%)", "paper (%)"]]
    records = read("own_policies", folder).values()
    for record in records:
        found, paper = record["results"], record["results"]["paper"]
        for model in found["models"]:
            about = found["task"], f"{model['model']}, {model['kind']}"
            returns = f"{model['return']:,.0f}, {model['promised']:,.0f}"
            shares = (percent(model[key]) for key in ("difference", "worst"))
            line = [*about, str(model["policies"]), returns, ", ".join(shares)]
            published = "-" if paper is None else f"{100.0 * paper:+.2g}"
            table.append([*line, published])
    return with_sources(table, records)


def falls_table(folder: Path = RESULTS) -> str:
    """Robots on their back along one policy, and how far those of a model run ahead."""
    shown, records = [], read("falls", folder).values()
    for record in records:
        found = record["results"]
        head = [f"{found['task']}, actions"]
        columns = len(found["on_their_back"]["MuJoCo"])
        head += [f"to {found['every'] * (i + 1)}" for i in range(columns)]
        body = [
            [name, *(f"{100.0 * x:.0f}%" for x in shares)]
            for name, shares in found["on_their_back"].items()
        ]
        shown += [rows([head, *body])]
        head = ["m farther than MuJoCo", *(f"after {k}" for k in found["after"])]
        body = [["MuJoCo's way", *(f"{x:.2f}" for x in found["progress_m"])]]
        for name, ahead in found["ahead_m"].items():
            both = (f"{x['mean']:.3f} ± {x['interval']:.3f}" for x in ahead)
            body.append([name, *both])
        shown += [rows([head, *body]), made_by(record)]
    return "\n\n".join(shown)


def open_loop_table(folder: Path = RESULTS) -> str:
    """Third-party robots: a network beside MuJoCo at few substeps, and their rates."""
    head = [
        "robot",
        "motion",
        "network",
        "no motion",
        "MuJoCo, 1 substep",
        "4 substeps",
    ]
    lines, records = [], read("open_loop", folder)
    rated = [["robot", "network", "rate / in bf16", "MuJoCo, 1 substep", "its own"]]
    rated[0] += ["front", "front, bf16"]
    for robot, record in records.items():
        found = record["results"]
        errors, rates, exact = (found[k] for k in ("errors", "rates", "ground_truth"))
        coarse = [
            [k for k in errors if k.startswith("MuJoCo") and f", {n} substep" in k]
            for n in (1, 4)
        ]
        rivals = [[k for k in same if k != exact] for same in coarse]
        fastest = max((rates[k] for k in rivals[0]), default=None)
        own = [rate(rates.get(k)) for k in ("compiled", "compiled bf16")]
        speeds = [" / ".join(own), rate(fastest), rate(rates[exact])]
        cases = list(dict.fromkeys(k.split(", ")[0] for k in errors["learned"]))
        for case in cases:
            columns = [["learned"], ["no motion"], *rivals]
            cells = (short_and_long(errors, names, case) for names in columns)
            lines.append([robot, case, *cells])
        fronts = (found.get(k) for k in ("on_the_front", "on_the_front_in_bf16"))
        places = (", ".join(places_of(x, cases)) if x else "-" for x in fronts)
        config = found["configuration"]
        count = config.get("symmetries", 1)
        nearly = "nearly " * config.get("near_symmetry", False)
        network = config["network"] + f", {nearly}{count} symmetries" * (count > 1)
        rated.append([robot, network, *speeds, *places])
    return "\n\n".join((rows([head, *lines]), with_sources(rated, records.values())))


def places_of(front: dict[str, bool], cases: list[str]) -> Iterator[str]:
    """In how many horizons and units a network is on the front, case by case."""
    for case in cases:
        own = [is_on for place, is_on in front.items() if place.startswith(case)]
        yield f"{sum(own)}/{len(own)}"


def self_contact_table(folder: Path = RESULTS) -> str:
    """Errors without features of the robot's contacts with itself, and with them."""
    if (record := one("self_contact", folder)) is None:
        return ""
    table = [["robot", "error of", "touching: without", "with", "others: without"]]
    table[0].append("with")
    for scene in dict.fromkeys(row["scene"] for row in record["results"]):
        own = [row for row in record["results"] if row["scene"] == scene]
        for key, what in (
            ("qvel_1", "`qvel`, 1 step, m/s and rad/s"),
            ("m_20", "positions, 20 steps, m"),
            ("rad_20", "rotations, 20 steps, rad"),
        ):
            line = [scene, what]
            for which in ("touching", "other"):
                for has_features in (False, True):  # a mean over seeds
                    alike = [x for x in own if x["self_contact"] is has_features]
                    mean = sum(x[f"{key}_{which}"] for x in alike) / len(alike)
                    line.append(f"{mean:.3g}")
            table.append(line)
    return with_sources(table, [record])


def symmetric_layers_table(folder: Path = RESULTS) -> str:
    """Errors of networks with and without built-in mirrors, means over seeds."""
    record = one("symmetric_layers", folder)
    if record is None:
        return ""
    names: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for row in record["results"]["rows"]:
        names.setdefault((row["network"], row["symmetries"]), []).append(row)
    quantities = ("base_position", "base_orientation", "joints")
    heads = ("position, m", "orientation, rad", "joints, rad")
    table = [["network", "symmetries", "weights", "time of an update", *heads]]
    first = None
    for (network, symmetries), alike in names.items():
        means = {
            key: sum(row[key] for row in alike) / len(alike)
            for key in ("seconds_per_update", *(f"{q}_500" for q in quantities))
        }
        first = first or means["seconds_per_update"]
        share = f"{means['seconds_per_update'] / first:.2f}"
        errors = [number(means[f"{q}_500"]) for q in quantities]
        count = f"{alike[0]['weights']:,}"
        table.append([f"`{network}`", str(symmetries), count, share, *errors])
    return with_sources(table, [record])


def products_table(folder: Path = RESULTS) -> str:
    """Errors of networks with and without products of features, by robot."""
    return pairs_table(folder, "products", "network", ("without", "with"))


def loss_weights_table(folder: Path = RESULTS) -> str:
    """Errors of networks whose loss weighs positions as speeds, or all alike, by robot."""
    return pairs_table(folder, "loss_weights", "positions", ("alike", "as speeds"))


def pairs_table(folder: Path, name: str, differs: str, shown: tuple[str, str]) -> str:
    """Errors of two trainings of each robot, whose rows differ in one entry."""
    head = "robot", "motion, steps", "error", *shown, "all quantities, ratio"
    table, records = [[*head, "time of an update"]], read(name, folder)
    for scene, record in records.items():
        first, second = means_of_two(record["results"]["rows"], differs)
        cost = second["seconds_per_update"] / first["seconds_per_update"]
        others = "seed", "weights", "seconds_per_update"
        groups: dict[str, list[str]] = {}
        for key in (key for key in first if key not in others):
            motion, steps = key.partition("_")[0], key.rpartition("_")[2]
            groups.setdefault(f"{motion}, {steps}", []).append(key)
        for group, keys in groups.items():
            logs = [log(second[key] / first[key]) for key in keys]
            ratio = exp(sum(logs) / len(logs))
            what = keys[0].partition("_")[2].rpartition("_")[0]
            errors = number(first[keys[0]]), number(second[keys[0]])
            table.append([scene, group, what, *errors, f"{ratio:.2f}", f"{cost:.2f}"])
    return with_sources(table, records.values())


def means_of_two(
    rows: list[dict[str, Any]], differs: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Means over seeds of rows like the first one, and of all others."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(row[differs], []).append(row)
    means = [
        {
            key: sum(row[key] for row in alike) / len(alike)
            for key, value in alike[0].items()
            if not isinstance(value, str)
        }
        for alike in groups.values()
    ]
    return means[0], means[1]


def short_and_long(errors: dict[str, Any], names: list[str], case: str) -> str:
    """Mean errors of the joints (rad) over 20 and 100 steps, the least of some rows."""
    places = [f"{case}, {steps} steps, rad" for steps in (20, 100)]
    if not names:
        return "-"
    # None: the rollout diverges
    means = ([errors[name][where]["mean"] for name in names] for where in places)
    best = (min((x for x in found if x is not None), default=inf) for found in means)
    return " / ".join(map(number, best))


def rate(value: float | None) -> str:
    """Thousands of control steps per second."""
    return "-" if value is None else f"{value / 1000:,.0f}k"


def spread(returns: dict[str, float]) -> str:
    """Mean return and half of its 95% interval."""
    return f"{returns['mean']:,.0f} ± {returns['interval']:,.0f}"


TABLES = {
    "eval": eval_tables,
    "bench": bench_tables,
    "stability": stability_tables,
    "env_rate": env_table,
    "kinematics_libraries": kinematics_table,
    "transfer": transfer_table,
    "state_dtype": state_dtype_table,
    "gpu_rates": gpu_rates_table,
    "gpu_errors": gpu_errors_table,
    "hidden_parameters": hidden_parameters_tables,
    "robots_that_load": robots_table,
    "policies": policies_table,
    "policy_curves": policy_curves_table,
    "open_loop": open_loop_table,
    "time_to_policy": time_to_policy_table,
    "unmet_policies": unmet_policies_table,
    "own_policies": own_policies_table,
    "falls": falls_table,
    "gallery": gallery_table,
    "returns": returns_table,
    "network_off": network_off_table,
    "self_contact": self_contact_table,
    "symmetric_layers": symmetric_layers_table,
    "products": products_table,
    "loss_weights": loss_weights_table,
}
MEASURED = "python benchmarks/{0}.py --json results/{0}.json"
COMMANDS = {"env_rate": MEASURED, "kinematics_libraries": MEASURED}
COMMANDS |= {"state_dtype": MEASURED, "gpu_rates": "make gpu", "gpu_errors": "make gpu"}
COMMANDS |= {"hidden_parameters": "python -m experiments.hidden_parameters"}
ROBOTS = "python experiments/robots_that_load.py --json results/robots_that_load.json"
COMMANDS |= {"robots_that_load": ROBOTS}
POLICIES = "python experiments/policies_in_the_model.py TASK --json FILE"
COMMANDS |= {"policies": POLICIES, "policy_curves": POLICIES}
COMMANDS |= {"open_loop": "python experiments/open_loop.py ROBOT --json FILE"}
TIMES = "python experiments/time_to_policy.py TASK --json FILE"
UNMET = "python experiments/unmet_policies.py TASK --policies FOLDER --json FILE"
OWN = "python experiments/own_policies.py TASK --policies FOLDERS --json FILE"
COMMANDS |= {"time_to_policy": TIMES, "unmet_policies": UNMET, "own_policies": OWN}
COMMANDS |= {"falls": "python experiments/falls.py TASK FOLDER --json FILE"}
COMMANDS |= {
    "network_off": "python experiments/network_off.py",
    "gallery": "make results",
}
COMMANDS |= {"self_contact": "python experiments/self_contact.py --json FILE"}
LAYERS = "python experiments/symmetric_layers.py --json FILE"
COMMANDS |= {"symmetric_layers": LAYERS}
COMMANDS |= {"products": "python experiments/products.py ROBOT --json FILE"}
COMMANDS |= {"loss_weights": "python experiments/loss_weights.py ROBOT --json FILE"}
COMMANDS |= {"returns": "nerd transfer TASK --json results/transfer_TASK.json"}
COMMAND = "nerd {0} ROBOT --json results/{0}_ROBOT.json"


def render(markdown: str, folder: Path = RESULTS) -> str:
    """A page with its tables; without results it says so."""

    def table(found: re.Match[str]) -> str:
        name = found[1]
        command = COMMANDS.get(name, COMMAND).format(name)
        return TABLES[name](folder) or f"`not measured` yet: `{command}`."

    return MARKER.sub(table, markdown)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Called by MkDocs for every page."""
    return render(markdown)

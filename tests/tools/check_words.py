"""Find words that the glossary replaced, in code, cards, messages and documentation.

    python tests/tools/check_words.py             # how often, by word and by file
    python tests/tools/check_words.py --lines     # every line

Exits with 1 where any is found. ``_`` and digits separate words, so that identifiers and
flags are read as well as sentences.
"""

import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
SUFFIXES = {".py", ".md", ".json", ".ipynb", ".toml", ".yml", ".xml", ""}
SKIPPED = (
    *("tests/tools/check_words.py", "tests/tools/test_words_and_size.py"),
    "experiments/first_edition*",  # pages as they were, and where they are
    *("constraints.txt", "LICENSE", "*/results/*"),
    *("results/*", "docs/figures/*", "docs/glossary.md", "*.safetensors", "typings/*"),
)

IS_TRUE = r"(is|num)_true|true[-_ ](share|transitions)"
FORCES = r"(?-i:push|drag|gain) =(?!=)"
ROWS = r"per[ _]row|row to row|rows? of envs?|(every|each|all) rows?(?! of)"
ROW_NAMES = r"(row_keys|bound_rows|num_rows)|rows (stepped|that it learns)"

WORDS = {
    # what steps the state
    r"(?<!ground )(?<!ground-)truths?": "ground truth",
    r"true (dynamics|physics|solver|steps?|engine|motion)|(?-i:true) env": "ground truth",
    IS_TRUE: "is_mujoco, mujoco_fraction",
    r"teachers?": "reference solver",
    r"networks? alone": "learned model",
    r"free motion": "unconstrained motion",
    r"free (step|ne ?rd|network)": "UnconstrainedStep, HybridNeRD",
    r"ground step|grounded (step|ne ?rd|config)|grounded": "PenaltyContactStep, HybridNeRD",
    r"(along|on) (its |the |their |a robot s )?springs": "penalty-contact step",
    r"(contact|limit) springs": "spring-damper forces",
    r"(num|one|two|three|pair of|last) looks?|glances?": "stages, dynamics evaluations",
    r"march(es|ed|ing)?": "integrate substeps",
    r"halves": "outer steps",
    r"levers": "contact Jacobian",
    r"limbs": "BranchSparsity",
    r"doubts?|half gate": "velocity defect, gate",
    r"joint stops?|ends of joints": "joint limits",
    r"foresees?|foreseen|foresight|foreseeing|coming depth": "predicted",
    r"flight bypass|flight shortcut": "contact-free bypass",
    r"untold( pushes)?|expect none": "unsupported forces, check_supported",
    r"set down|(the|self) mount|mount quat": "place_on_terrain, base frame",
    FORCES: "normal_force, friction_force, velocity_change",
    r"flies(?! (off|up))": "is_airborne, off the ground",
    r"def look(?! up)": "dynamics evaluation, profile_step",
    r"has simulator": "kind",
    # data and training
    r"nudged?|nudges": "perturbed, settled",
    r"(passive|quiet|single|short|bf ?\d* ?) ?share": "fraction",
    r"least scale": "min_torque_scale",
    r"lr other|rollout lr(?! ratio)|rollout rounds|softening": "training settings",
    r"legs? of training|two legs$|learn on": "stage, continue training",
    r"telling rows?|mirror images": "hard examples, symmetry augmentation",
    r"symmetry s? ?images?": "symmetry augmentation, symmetric copies",
    r"images? of (the )?(step|samples?|states?|tokens?|positions|velocities)": (
        "symmetric copies"
    ),
    r"recipes?": "training preset",
    r"(mlp|transformer|grounded|free|residual) (tiny|wide|small|larger|fine|halves)": (
        "kind and size"
    ),
    # envs, evaluation, command line
    ROWS: "env, trajectory, sample, frame",
    ROW_NAMES: "num_envs, is_reset",
    r"coverage": "TrainingRange, OODScore",
    r"(training |its |the )box": "training range",
    r"fault folder": "dump_dir",
    r"remembers?|remembered|recalls?": "history, frame_stack",
    r"steps per action": "frame_skip",
    r"races?|contenders?": "benchmark, candidate",
    r"chaos( floor)?": "sensitivity to initial state",
    r"(not )?met": "pass, fail",
    r"lines? (of the|that every) (true|learned|dynamics)": "tolerance",
    r"poser|ghosts?|films?|movies?": "renderer, overlay, video",
    r"own actions|draw(er)? drawing": "--closed-loop",
    r"ground [1-6]": "terrain 1 to 6",
    r"stances?|dear|astray|errs|spoilt|side study": "plain words",
    r"beside other work|robots? of others": "loaded machine, third-party robot",
    r"figures(?! \d)": "results, metrics",
}
"""Left column of the glossary as a regular expression, and what to write instead."""

RAW = {r"ground [1-6]", IS_TRUE, FORCES, ROWS, ROW_NAMES}
"""Words that are looked for in the line as it is, with its punctuation."""

ALLOWED = {
    r"limbs": ("torchrl_nerd/geometry/spd.py", "tests/tools/test_check_source.py"),
    r"figures(?! \d)": (
        "README.md",
        "docs/*",
        "mkdocs.yml",
        "*plot*",
        "benchmarks/draw_benchmarks.py",
        "tests/test_docs.py",
    ),
    FORCES: (
        "tests/*",
        "experiments/hidden_parameters/identify.py",
        "torchrl_nerd/evaluation/policy.py",
    ),
    ROWS: ("docs/evaluation.md", "tests/geometry/*"),  # of tables and of matrices
    r"(not )?met": ("*.json", "tests/data/tosses_excerpt.md"),
}
"""Files in which a word is used in another meaning."""

PATTERNS = {
    word: re.compile(rf"(?<![a-z])(?:{word})(?![a-z])", re.IGNORECASE) for word in WORDS
}
CAMEL = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")
SEPARATORS = re.compile(r"[_\W]+")


class Hit(NamedTuple):
    """One word found."""

    word: str
    path: str
    line: int
    text: str


def words_of(line: str) -> str:
    """A line as plain words: identifiers taken apart, punctuation gone."""
    return SEPARATORS.sub(" ", CAMEL.sub(" ", line))


def hits(path: str, text: str) -> Iterator[Hit]:
    """Every forbidden word of a file."""
    for number, line in enumerate(text.splitlines(), 1):
        plain = words_of(line)
        for word, pattern in PATTERNS.items():
            if any(fnmatch(path, allowed) for allowed in ALLOWED.get(word, ())):
                continue
            for _ in pattern.finditer(line if word in RAW else plain):
                yield Hit(word, path, number, line.strip())


def sources() -> Iterator[tuple[str, str]]:
    """Path and text of every tracked text file that is looked at."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=True
    )
    for name in names.stdout.splitlines():
        path = ROOT / name
        is_skipped = any(fnmatch(name, pattern) for pattern in SKIPPED)
        if path.suffix in SUFFIXES and path.is_file() and not is_skipped:
            yield name, path.read_text(encoding="utf-8", errors="ignore")


def main(arguments: list[str]) -> int:
    """Print what was found, and return the exit status."""
    found = [hit for name, text in sources() for hit in hits(name, text)]
    if "--lines" in arguments:
        chosen = [a for a in arguments if not a.startswith("--")]
        for hit in found:
            if not chosen or any(hit.path.startswith(part) for part in chosen):
                print(f"{hit.path}:{hit.line}: {hit.word}: {hit.text}")
    else:
        by_word = Counter(hit.word for hit in found)
        for word, count in by_word.most_common():
            print(f"{count:>6}  {word}  ->  {WORDS[word]}")
        for path, count in Counter(hit.path for hit in found).most_common():
            print(f"{count:>6}  {path}")
    print(f"{len(found)} words of the glossary's left column")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""``nerd stability``: hard cases, in MuJoCo and in a model."""

from dataclasses import asdict, dataclass
from typing import Any

from tqdm import tqdm

from torchrl_nerd.checkpoint import from_pretrained, model_name
from torchrl_nerd.cli.command import MeasuringCommand
from torchrl_nerd.cli.options import ModelName, Positional, SceneName
from torchrl_nerd.dynamics import Model, dynamics_of
from torchrl_nerd.evaluation.stability.case import Case, as_table, run_cases
from torchrl_nerd.evaluation.stability.cases import CASES
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene
from torchrl_nerd.settings import SettingError, look_up


@dataclass(frozen=True)
class Stability(MeasuringCommand):
    """Hard cases: conservation, contact, invariance, bad input, long runs, gradients.

    Every metric is graded against a tolerance. The exit status is 0 even where a case
    fails.

    Example: nerd stability cartpole --json results/stability.json
    """

    scene: Positional[SceneName]
    cases: tuple[str, ...] = ()
    """Names of cases; all that apply by default."""
    model: ModelName = None
    seed: int = 0
    """Seed of starts and torques."""
    scale: float = 1.0
    """Fraction of long rollouts and of large batches, in (0, 1]."""
    compile: bool = False
    """Compile the model's step: long cases take a fraction of the time."""

    def inputs(self) -> tuple[list[Case], Scene, str, Model]:
        """Cases, robot, name of the model and the model; refuse bad input."""
        if not 0.0 < self.scale <= 1.0:
            raise SettingError(f"expected a scale in (0, 1], got {self.scale}")
        cases = [look_up("case", name, CASES) for name in self.cases or CASES]
        scene, name = load_scene(self.scene), self.model or self.scene
        model = from_pretrained(name, scene).to(self.device)
        tested = dynamics_of(model)
        for case in cases if self.cases else ():
            if not case.supports(tested):
                raise SettingError(
                    f"expected cases that apply to '{scene.name}' and its {model.kind} "
                    f"model, got {case.name}"
                )
        return cases, scene, name, model

    def run(self) -> dict[str, Any]:
        """Print verdicts, then the table, and return the results; refuse bad input."""
        cases, scene, name, model = self.inputs()
        tested = dynamics_of(model, compile=self.compile)
        results, count = [], sum(case.supports(tested) for case in cases)
        about = {"model": model_name(name, scene), "kind": model.kind}
        found: dict[str, Any] = {"scene": self.scene, **about}
        found |= {"seed": self.seed, "scale": self.scale}
        trials = run_cases(tested, cases, self.seed, self.scale)
        for result in tqdm(trials, "cases", count, leave=False, disable=self.quiet):
            verdict = "pass" if result.passes else "FAIL"
            verdict = "skip" if result.skipped else verdict
            line = f"{result.case:<21}{verdict:<6}{result.seconds:>7} s"
            tqdm.write(f"{line}  {result.skipped}".rstrip())
            results.append(result)
            found[result.case] = asdict(result)
            self.keep(found)  # hours of long cases outlive an interruption
        print(f"\n{as_table(results, model.kind)}")
        return found

"""Picture of the gallery: every robot after some steps in its learned dynamics.

python docs/pictures.py
"""

from pathlib import Path

from matplotlib.figure import Figure

from torchrl_nerd import make_env

OUT = Path(__file__).parent / "figures" / "robots.png"
TASKS = {  # task -> steps until the picture
    "cartpole/swingup": 20,
    "double_pendulum/passive": 40,
    "ant/run": 30,
    "anymal/forward": 20,
    "franka/reach": 20,
    "cube/toss": 20,
}


def main() -> None:
    """Draw them side by side."""
    figure = Figure(figsize=(9.0, 6.2), layout="constrained")
    places = figure.subplots(2, 3).flat
    for axes, (name, steps) in zip(places, TASKS.items(), strict=True):
        env = make_env(name, seed=0, from_pixels=True, render_size=360)
        seen = env.rollout(steps, break_when_any_done=False)
        axes.imshow(seen["next", "pixels"][0, -1])
        axes.set_title(env.task.scene.name.replace("_", " "))
        axes.axis("off")
    figure.savefig(OUT, dpi=100)


if __name__ == "__main__":
    main()

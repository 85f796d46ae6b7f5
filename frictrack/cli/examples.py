"""Two examples of every command, shown at the end of its help."""

from __future__ import annotations

WHOLE_PROGRAM = (
    "frictrack demo                              the whole analysis on a sample",
    "frictrack init films                        a study file for your own films",
)
EXAMPLES = {
    "run": (
        "frictrack run study.toml",
        "frictrack run a.avi b.avi --mass 0.35kg --scale 0.5mm/px --fps 4000",
    ),
    "init": ("frictrack init films", "frictrack init films --mass 350g --scale 0.5mm/px --fps 4000"),
    "track": ("frictrack track study.toml", "frictrack track study.toml --overlay --workers 4"),
    "motion": ("frictrack motion study.toml", "frictrack motion study.toml --json > motion.json"),
    "friction": ("frictrack friction study.toml", "frictrack friction study.toml --json > friction.json"),
    "fit": (
        "frictrack fit study.toml --model tustin,texture",
        "frictrack fit study.toml --search mga --set generations=500",
    ),
    "compare": ("frictrack compare study.toml", "frictrack compare study.toml --parameter viscous.F_v"),
    "diagnose": ("frictrack diagnose study.toml", "frictrack diagnose study.toml --quick"),
    "add": ("frictrack add study.toml texture", "frictrack add study.toml formula:1"),
    "remove": ("frictrack remove study.toml texture", "frictrack remove study.toml viscous"),
    "history": ("frictrack history study.toml", "frictrack history study.toml --json > history.json"),
    "plan": ("frictrack plan study.toml", "frictrack plan study.toml --json > plan.json"),
    "report": ("frictrack report study.toml", "frictrack report study.toml --pdf"),
    "export": ("frictrack export study.toml --to netcdf", "frictrack export study.toml --to crate --license CC-BY-4.0"),
    "effects": ("frictrack effects", "frictrack effects study.toml texture"),
    "render": ("frictrack render scene.toml -o films", "frictrack render scene.toml -o films --seed 3"),
    "app": ("frictrack app study.toml", "frictrack app study.toml --port 8080 --no-browser"),
    "batch": ("frictrack batch campaign", 'frictrack batch "campaign/*/study.toml" -o all --workers 8'),
    "verify": ("frictrack verify study.toml", "frictrack verify campaign"),
    "demo": ("frictrack demo", "frictrack demo --json > demo.json"),
    "explain": ('frictrack explain "held out"', "frictrack explain patch"),
    "docs": ("frictrack docs", "frictrack docs --path"),
    "reproduce": ("frictrack reproduce study.crate.zip --recordings films", "frictrack reproduce --quick -o papers"),
    "make": ("frictrack blind make trial --n 40", "frictrack blind make trial --film --seed 7"),
    "score": ("frictrack blind score trial", "frictrack blind score trial --workers 4"),
}  # command -> lines of at most 76 characters


def format_examples(lines: tuple[str, ...]) -> str:
    r"""Return the end of a help; the first line, ``\b``, keeps the line ends.

    Examples
    --------
    >>> format_examples(("frictrack demo",)).splitlines()[1:]
    ['Examples:', '  frictrack demo']

    """
    return "\n".join(("\b", "Examples:", *(f"  {line}" for line in lines)))

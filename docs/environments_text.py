"""Text of reference/environments.md, made from the cards of all environments that ship with acwm.

The overview is part of the page; the site adds a section on every environment.
"""

import inspect
from pathlib import Path

from acwm_core.env.environment import ActionSpec, EnvironmentCard, StateField
from acwm_core.env.episode import Factor
from acwm_core.plugins import catalog

PLUGINS = Path(__file__).resolve().parent.parent / "plugins"

ORDER = (
    "push_cube",
    "stack_cube",
    "push_rope",
    "cloth_move",
    "push_sand",
    "pour_water",
    "robot_arm",
    "reacher",
)
"""Order of the paper; other environments follow by name."""


_SECTIONS = ("Args:", "Raises:", "Attributes:", "Returns:")


def cards() -> dict[str, EnvironmentCard]:
    """The cards of all environments in this repository's plugins, in the order of the page."""
    found: dict[str, EnvironmentCard] = {}
    for part in catalog().registry("environment"):
        if (PLUGINS / part.target.partition(".")[0]).is_dir():
            found[part.name] = part.load().card
    ranks = {name: rank for rank, name in enumerate(ORDER)}
    return dict(sorted(found.items(), key=lambda item: (ranks.get(item[0], len(ORDER)), item[0])))


def families(found: dict[str, EnvironmentCard]) -> dict[str, list[str]]:
    """Environments that are not variants, each with its variants."""
    variants = {name for card in found.values() for name in card.variants}
    return {
        name: [v for v in card.variants if v in found]
        for name, card in found.items()
        if name not in variants
    }


def overview(found: dict[str, EnvironmentCard]) -> str:
    """The tables of all environments that are not variants: what happens, and what is generated."""
    shown = {f"[{name}](#{name})": found[name] for name in families(found)}
    worlds = [
        (name, card.summary, card.engine, f"{card.action.size}, {card.action.kind}")
        for name, card in shown.items()
    ]
    defaults = [
        (name, str(card.horizon), _size(card), _episodes(card), ", ".join(card.ood_shifts))
        for name, card in shown.items()
    ]
    return "\n\n".join(
        [
            _table(("World", "What happens", "Engine", "Action"), worlds),
            "Defaults of `acwm generate`, with episodes of `train` / `ind_test` / `ood_test`; "
            "options change them:",
            _table(("World", "Frames", "Size", "Episodes", "OoD shifts"), defaults),
        ]
    )


def sections(found: dict[str, EnvironmentCard]) -> str:
    """A section on every environment, as Markdown."""
    parts: list[str] = []
    for name, variants in families(found).items():
        parts += _section(found[name])
        for variant in variants:
            parts += _variant(found[variant], found[name])
    return "\n\n".join(parts)


def _section(card: EnvironmentCard) -> list[str]:
    parts = [
        f"## {card.name}",
        card.summary,
        *_notes(card),
        f"{card.engine} · {_size(card)} pixels · {card.fps} frames per second · {card.horizon} "
        f"frames ({card.horizon / card.fps:g} s) · {_episodes(card)} episodes (train / ind_test / "
        f"ood_test) · {card.citation}",
        f"![{card.name}, in distribution](../environments/{card.name}_ind.jpg)",
        f"![{card.name}, out of distribution](../environments/{card.name}_ood.jpg)",
        _action(card.action),
        _factors(card),
    ]
    if any(not factor.active for factor in card.factors):
        parts.append(f"![{card.name}, its factors](../environments/{card.name}_factors.jpg)")
    return [*parts, _state(card.state), _instances(card)]


def _notes(card: EnvironmentCard) -> list[str]:
    """The docstring of the environment's class after its first paragraph, as paragraphs."""
    text = inspect.getdoc(catalog().component("environment", card.name).load()) or ""
    paragraphs = [" ".join(each.split()) for each in text.split("\n\n")[1:]]
    return [each.replace("``", "`") for each in paragraphs if not each.startswith(_SECTIONS)]


def _variant(card: EnvironmentCard, base: EnvironmentCard) -> list[str]:
    """The section of a variant: where it differs from its base."""
    parts = [f"### {card.name}", f"*Variant of {base.name}.* {card.summary}"]
    parts.append(f"![{card.name}](../environments/{card.name}.jpg)")
    if _facts(card) != _facts(base):
        parts.append(_facts(card))
    if card.action != base.action:
        parts.append(_action(card.action))
    if card.factors != base.factors:
        parts.append(_factors(card))
    elif card.ood_shifts != base.ood_shifts:
        parts.append(f"`ood_test` shifts {_listed(card.ood_shifts)}.")
    if card.state != base.state:
        parts += _changed_state(card, base)
    if card.instances != base.instances:
        parts.append(_instances(card))
    return parts


def _facts(card: EnvironmentCard) -> str:
    return (
        f"{card.engine} · {_size(card)} pixels · {card.horizon} frames · {_episodes(card)} episodes"
    )


def _size(card: EnvironmentCard) -> str:
    return "×".join(map(str, card.frame_size))


def _episodes(card: EnvironmentCard) -> str:
    return " / ".join(str(count) for count in card.episodes.values())


def _action(action: ActionSpec) -> str:
    rows = [
        (f"`{name}`", unit or "–", f"{low:g}", f"{high:g}")
        for name, unit, low, high in zip(
            action.names, action.units, action.low, action.high, strict=True
        )
    ]
    return _table((f"Action ({action.kind})", "Unit", "Min", "Max"), rows)


def _factors(card: EnvironmentCard) -> str:
    rows = [
        (
            f"**{factor.name}**" if factor.active else factor.name,
            factor.description + (f" ({factor.unit})" if factor.unit else ""),
            _region(factor, (factor.train,)),
            _region(factor, factor.ood),
            _value(factor.nominal),
        )
        for factor in card.factors
    ]
    shift = f"Factor; `ood_test` shifts {_listed(card.ood_shifts)}"
    return _table((shift, "Meaning", "Training", "OoD", "Nominal"), rows)


def _region(factor: Factor, values: tuple) -> str:
    if factor.kind == "discrete":
        listed = values[0] if values == (factor.train,) else values
        return ", ".join(map(_value, listed))
    return ", ".join(f"{low:g} to {high:g}" for low, high in values)


def _value(value: float | int | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def _state(state: tuple[StateField, ...]) -> str:
    rows = [
        (
            f"`{f.name}`",
            "×".join(map(str, f.shape)) or "1",
            f.unit or "–",
            " and ".join(f.kinds),
            f.description,
        )
        for f in state
    ]
    return _table(("State", "Shape", "Unit", "Kind", "Meaning"), rows)


def _changed_state(card: EnvironmentCard, base: EnvironmentCard) -> list[str]:
    """The state fields of a variant that differ from those of its base."""
    table = _state(tuple(field for field in card.state if field not in base.state))
    kept = [field.name for field in card.state if field in base.state]
    return [table, f"The other states are those of {base.name}."] if kept else [table]


def _instances(card: EnvironmentCard) -> str:
    return "Mask: " + ", ".join(f"{k} {name}" for k, name in enumerate(card.instances)) + "."


def _listed(names: tuple[str, ...]) -> str:
    return " and ".join(f"`{name}`" for name in names)


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(c.replace("|", "\\|") for c in row) + " |" for row in lines)

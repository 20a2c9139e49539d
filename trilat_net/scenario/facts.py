"""What a valid scenario says, in lines for people."""

from collections.abc import Iterator

from .model import Scenario


def scenario_facts(scenario: Scenario) -> list[str]:
    """Returns what a valid scenario says, and what follows from it."""
    beta = scenario.beta
    weights = (
        "none: alpha is reducible, some site's weight is zero"
        if beta is None
        else ", ".join(f"{name} {weight:.4g}" for name, weight in zip(scenario.names, beta, strict=True))
    )
    return [
        f"{scenario.name}: valid, sha256 {scenario.sha256[:16]}",
        f"sites: {', '.join(scenario.names)}; {scenario.duration_s:g} s, "
        + ", ".join(f"{scenario.ticks(name)} ticks of {name}" for name in scenario.names),
        *_link_facts(scenario),
        f"beta, the left null vector of Upsilon: {weights}",
        *(f"assumed: {text}" for text in scenario.assumed),
    ]


def _link_facts(scenario: Scenario) -> Iterator[str]:
    """Yields what the links do: in one line where all do the same."""
    words = {name: link.describe() for name, link in scenario.links.items()}
    if len(set(words.values())) == 1:
        yield f"every link: {next(iter(words.values()))}"
        return
    for name, text in words.items():
        yield f"link {name}: {text}"

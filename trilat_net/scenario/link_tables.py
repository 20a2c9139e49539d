"""Completes the link tables of a scenario with defaults, presets and recorded delays.

The table `link` applies to all links, and the table `links` contains the settings of individual
links such as "m1->s".

Invariant:
    - A complete link contains the keys of its preset but not the name of the preset, so a later
      change to the preset does not affect the experiment. It contains recorded delays but names
      no file.
"""

from ..errors import ScenarioError, suggest_nearest
from ..fields import TomlTable
from .delay_models import DELAY_MODELS
from .key_checks import check_choice, check_keys, list_fields
from .link_presets import PRESETS
from .named_files import NamedFiles
from .refusals import check_table
from .suggestions import list_link_paths
from .written_tables import TRACE_KEYS, check_link


def complete_link_tables(
    common: TomlTable, written: TomlTable, names: list[str], files: NamedFiles
) -> TomlTable:
    """Returns a mapping from link name to the complete table of each network link.

    Keys that the author left out are taken from `common`, or set to their defaults.

    Args:
        common: Table `link`, the settings of all links as written by their author.
        written: Mapping from link name to the settings of an individual link.
        names: Names of all sites.
        files: Delay files that the links may name.

    Raises:
        ScenarioError: There is no such link, or a table is not valid.
    """
    link_names = [f"{peer}->{site}" for site in names for peer in names if peer != site]
    check_keys(written, link_names, "links", list_link_paths())
    common_link = _join_link(common, {}, "link")
    return {
        name: complete_link(
            written=check_table(written.get(name, {}), TomlTable, f"links.{name}"),
            common=common_link,
            name=name,
            files=files,
            path=f"links.{name}",
        )
        for name in link_names
    }


def complete_link(
    written: TomlTable, common: TomlTable, name: str, files: NamedFiles, path: str
) -> TomlTable:
    """Returns the complete table of a link, or of a site's delayed view of its peers.

    A view specifies how much later the user of a site sees the other arms move. It has the keys
    of a link but does not inherit their values.

    Args:
        written: The link table as written by its author.
        common: Settings of all links, including defaults. Empty for a view.
        name: Name under which a log stores the delays of the link.
        files: Delay files that the link may name.
        path: Path of the table, for error messages.

    Raises:
        ScenarioError: A key is unknown, missing or wrong, or a file cannot be used.
    """
    link = _join_link(written, common, path)
    kind = DELAY_MODELS[link["model"]]
    if link["model"] == "trace":
        is_common_file = "file" in common and "file" not in written
        trace = files.read_trace(link, name, "link" if is_common_file else path)
        link = {key: value for key, value in link.items() if key not in TRACE_KEYS}
        link["trace"] = trace

    link = {**kind.derive_keys(link), **link}
    for field in list_fields(kind):
        if field.required and field.name not in link:
            advice = "; give it here or in [link]" if common else ""
            raise ScenarioError(f"is missing{advice}", path=f"{path}.{field.name}")
    return link


def _join_link(written: TomlTable, common: TomlTable, path: str) -> TomlTable:
    """Completes the settings of a link with those that it inherits.

    The source of the missing settings depends on what the author wrote:

    - If the link names a preset, they are taken from the preset.
    - If it names only a delay model, nothing is inherited, since each model has its own
      settings.
    - Otherwise, they are taken from the common settings of all links.

    Delay traces are not read here.

    Args:
        written: Settings of the link as written by the author.
        common: Complete common settings of all links.
        path: Path of the settings in the scenario, for error messages.

    Raises:
        ScenarioError: The preset, model or key does not exist, or the preset has a different
            model.
    """
    defaults = {} if "model" in written else common
    if "preset" in written:
        check_choice(written["preset"], list(PRESETS), f"{path}.preset")
        defaults = PRESETS[written["preset"]]
    model = written.get("model", defaults.get("model", "constant"))
    check_choice(model, list(DELAY_MODELS), f"{path}.model")
    if model != defaults.get("model", model):
        raise ScenarioError(
            f"is {model!r}, but the preset {written['preset']!r} is {defaults['model']!r}: "
            "give only one of the two",
            path=f"{path}.model",
        )
    check_link(written, model, path)

    # Delays that the author writes out replace a default file, and a file that the author names
    # replaces default delays.
    replaced_keys: tuple[str, ...] = ("preset",)
    if "trace" in written:
        replaced_keys = ("preset", *TRACE_KEYS)
    elif "file" in written:
        replaced_keys = ("preset", "trace")
    inherited = {key: value for key, value in defaults.items() if key not in replaced_keys}
    link = {**inherited, **written, "model": model}
    link.pop("preset", None)
    return link


def change_link(written: TomlTable, name: str, current: TomlTable, path: str) -> TomlTable:
    """Returns the complete table of a link after a change during a run.

    A change must not name a file, alter the outages of the link, or replace one delay trace
    with another.

    Args:
        written: Table `to` of the change, which contains the keys to change.
        name: Name of the link.
        current: Mapping from link name to the complete table before the change.
        path: Path of the change, for error messages.

    Raises:
        ScenarioError: There is no such link, or the change is not allowed.
    """
    if name not in current:
        names = list(current)
        hint = suggest_nearest(name, names) or f"; the links are {', '.join(names)}"
        raise ScenarioError(f"there is no link {name!r}{hint}", path=f"{path}.link")

    before = current[name]
    after = _join_link(written, before, f"{path}.to")
    if any(key in after for key in TRACE_KEYS):
        raise ScenarioError("no file can be named here", path=f"{path}.to.file")
    if after["model"] == "trace" and after.get("trace") != before.get("trace"):
        raise ScenarioError("a run cannot change to another trace", path=f"{path}.to.model")
    if "outages_s" in written and written["outages_s"] != before.get("outages_s"):
        raise ScenarioError(
            "belongs to [links]; outages cannot be changed during a run",
            path=f"{path}.to.outages_s",
        )

    after = {**DELAY_MODELS[after["model"]].derive_keys(after), **after}
    if "outages_s" in before:
        after["outages_s"] = before["outages_s"]
    return after

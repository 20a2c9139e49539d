"""Lists the keys of other tables that the author of a scenario may have meant by a wrong key.

A scenario is a TOML file that describes an experiment. A user who writes only the last part of
the path of a key, such as "delay_ms", learns the whole path from the error.
"""

from functools import cache

from .delay_models import DELAY_MODELS
from .key_checks import field_names
from .laws import LAWS
from .site_spec import SITE_GROUPS


@cache
def list_link_paths() -> tuple[str, ...]:
    """Returns the dotted paths of the keys that apply to all network links, as in "link.loss".

    Messages about a misspelt key suggest them.
    """
    keys = {key for model in DELAY_MODELS.values() for key in field_names(model)}
    return tuple(f"link.{key}" for key in ("model", "preset", *sorted(keys)))


def list_group_paths() -> list[str]:
    """Returns the dotted paths of the keys that apply to all arms or to all network links.

    Messages about a misspelt key suggest them.
    """
    gains = {key for law in LAWS.values() for key in field_names(law)}
    paths = [*list_link_paths(), *(f"control.{key}" for key in ("law", *sorted(gains)))]
    for group, kind in SITE_GROUPS.items():
        paths += [f"{group}.{key}" for key in field_names(kind)]
    return paths

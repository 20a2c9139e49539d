"""Lists keys of other tables that the author of a scenario may have meant by a wrong key.

If a user writes only the last part of a key path, such as "delay_ms", the error message
suggests the full path.
"""

from functools import cache

from .delay_models import DELAY_MODELS
from .key_checks import field_names
from .laws import LAWS
from .site_spec import SITE_GROUPS


@cache
def list_link_paths() -> tuple[str, ...]:
    """Returns the dotted paths of the keys that apply to all links, such as "link.loss".

    Used for suggestions in messages about misspelt keys.
    """
    keys = {key for model in DELAY_MODELS.values() for key in field_names(model)}
    return tuple(f"link.{key}" for key in ("model", "preset", *sorted(keys)))


def list_group_paths() -> list[str]:
    """Returns the dotted paths of the keys that apply to all arms or to all links.

    Used for suggestions in messages about misspelt keys.
    """
    gains = {key for law in LAWS.values() for key in field_names(law)}
    paths = [*list_link_paths(), *(f"control.{key}" for key in ("law", *sorted(gains)))]
    for group, kind in SITE_GROUPS.items():
        paths += [f"{group}.{key}" for key in field_names(kind)]
    return paths

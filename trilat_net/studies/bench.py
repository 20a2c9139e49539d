"""Names of `trilat_studies.bench`, which files of users import from here."""

from trilat_studies.bench import *  # noqa: F403
from trilat_studies.bench import __all__ as __all__

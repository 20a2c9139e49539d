"""Names of `trilat_studies.sweep`, which files of users import from here."""

from trilat_studies.sweep import *  # noqa: F403
from trilat_studies.sweep import __all__ as __all__

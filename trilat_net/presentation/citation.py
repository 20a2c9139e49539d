"""Composes a paragraph about the stability of a run for use in a paper, with references.

The paragraph names the scenario, the program, the verdict and its basis, and the underlying
values, so that a reader of the paper can reproduce and assess the statement. References follow
as BibTeX entries.

Invariant:
    - The paragraph states only facts that are in the certificate.
    - A source is listed only if the statement relies on it.
"""

from collections.abc import Iterator, Mapping

from ..analysis import Certificate, Stability
from ..errors import count_nouns
from ..files import find_version
from ..log import Log, collect_provenance
from ..scenario import Scenario

_SOFTWARE = """@software{{trilat_net,
  title   = {{trilat-net}},
  author  = {{{{The trilat-net authors}}}},
  version = {{{version}}},
  license = {{MIT}}{note}
}}"""
_PUSHES = """@article{Benettin1980,
  title   = {Lyapunov characteristic exponents for smooth dynamical systems and for
             {Hamiltonian} systems; a method for computing all of them},
  author  = {Benettin, Giancarlo and Galgani, Luigi and Giorgilli, Antonio and
             Strelcyn, Jean-Marie},
  journal = {Meccanica},
  volume  = {15},
  year    = {1980}
}"""
_ROOTS = """@book{Saad2011,
  title     = {Numerical Methods for Large Eigenvalue Problems},
  author    = {Saad, Yousef},
  edition   = {2},
  publisher = {SIAM},
  year      = {2011}
}"""
_POSITION_EXCHANGE = """@article{Nuno2009,
  title   = {Position tracking for non-linear teleoperators with variable time delay},
  author  = {Nu{\\~n}o, Emmanuel and Basa{\\~n}ez, Luis and Ortega, Romeo and Spong, Mark W.},
  journal = {The International Journal of Robotics Research},
  volume  = {28},
  number  = {7},
  year    = {2009},
  doi     = {10.1177/0278364908099461}
}"""
_THEOREM = """@inproceedings{Motaharifar2016,
  title     = {Adaptive control of dual user teleoperation with time delay and dynamic
               uncertainty},
  author    = {Motaharifar, M. and Bataleblu, A. and Taghirad, H. D.},
  booktitle = {24th Iranian Conference on Electrical Engineering (ICEE)},
  year      = {2016},
  note      = {The proof is used as corrected in the errata of trilat-net}
}"""
_STATEMENTS = {
    Stability.STABLE: "is stable",
    Stability.SETTLED: "settled, without a proof of stability",
    Stability.NOT_STABLE: "is not stable",
    Stability.OPEN: "could not be decided",
}


def compose_citation(log: Log, certificate: Certificate) -> Iterator[str]:
    """Yields a paragraph about a run for use in a paper, followed by its references as BibTeX.

    The paragraph states the scenario, the verdict and its basis, and the program.

    Args:
        log: The log of the run.
        certificate: Stability certificate of the run.
    """
    yield " ".join(_compose_sentences(log, certificate))
    yield ""
    yield _SOFTWARE.format(version=find_version(), note=_format_commit())
    for entry in _list_sources(certificate):
        yield ""
        yield entry


def _compose_sentences(log: Log, certificate: Certificate) -> Iterator[str]:
    """Yields the sentences of a paragraph about a run and its stability, for use in a paper.

    The sentences state the scenario, the control laws and delays, the verdict and its basis,
    the methods used (with citations), and the condition of the log.
    """
    scenario = log.scenario
    ticks = sum(len(log[site]) for site in log.sites)
    yield (
        f"The run of the scenario {scenario.name} (SHA-256 {scenario.sha256[:16]}, "
        f"{count_nouns(len(scenario.names), 'site')}, seed {scenario.seed}) was recorded with "
        f"{count_nouns(ticks, 'record')} and judged with trilat-net {find_version()} "
        "\\cite{trilat_net}."
    )

    yield from _state_settings(scenario)
    decision = certificate.decision
    statement = f"The run {_STATEMENTS[decision.stability]}"
    if decision.rests_on:
        statement += f"; this rests on {decision.rests_on}"
    yield f"{statement}."

    if certificate.law_proofs:
        yield "A stability condition of its control law holds \\cite{Nuno2009}."
    if certificate.has_functional:
        yield (
            "The premises of the theorem on adaptive dual-user teleoperation "
            "\\cite{Motaharifar2016}, which holds in continuous time and whose proof was "
            "corrected in trilat-net \\cite{trilat_net}, were compared with the run."
        )

    if decision.reasons:
        yield f"Findings that prevent a better judgement: {'; '.join(decision.reasons)}."
    if certificate.roots is not None and certificate.roots.verdict:
        yield (
            "The loop in force at the end of the run was linearised at the final pose: "
            f"{certificate.roots.text.removeprefix('this rest: ')} \\cite{{Saad2011}}."
        )

    twins = certificate.twins
    if twins is not None and twins.pushes:
        pushes = len({growth.push.name for growth in twins.pushes})
        pushes_text = count_nouns(pushes, "small push")
        yield (
            f"The run was executed again with {pushes_text} of its joints "
            f"and estimates \\cite{{Benettin1980}}; {twins.text.removeprefix('twins: ')}."
        )

    evidence = certificate.evidence.text
    yield f"Log: {evidence}."


def _state_settings(scenario: Scenario) -> Iterator[str]:
    """Yields sentences for a paper on the delays and on the control laws with their gains.

    Arms with the same law and gains share an entry, and so do links with the same delay.
    """
    law_texts = {}
    for name, site in scenario.sites.items():
        code_note = ""

        # The law is a user's Python class. Its hash tells which version of the file was used.
        user_law = site.user_law
        if user_law is not None:
            code_note = (
                f", other settings as in its file (SHA-256 {user_law.source_sha256[:16]})"
            )

        gains_text = ", ".join(f"{key} {text}" for key, text in site.describe_gains().items())
        law_texts[name] = (
            f"{site.law_name} ({gains_text}){code_note}"
            if gains_text
            else f"{site.law_name}{code_note}"
        )

    delay_texts = {name: link.describe() for name, link in scenario.links.items()}
    if law_texts:
        yield f"Control laws: {_group_equal(law_texts)}."
    if delay_texts:
        yield f"Delays of the links: {_group_equal(delay_texts)}."
    if scenario.timeline:
        yield f"The scenario plans {count_nouns(len(scenario.timeline), 'change')} of settings."


def _group_equal(texts: Mapping[str, str]) -> str:
    """Joins descriptions of several objects, merging equal ones and listing the object names.

    If all descriptions are equal, the description is returned once, without names.
    """
    names: dict[str, list[str]] = {}
    for name, text in texts.items():
        names.setdefault(text, []).append(name)
    if len(names) == 1:
        return next(iter(names))
    return "; ".join(f"{', '.join(owners)}: {text}" for text, owners in names.items())


def _format_commit() -> str:
    """Returns the BibTeX field with the commit of this program. Empty if unknown."""
    facts = collect_provenance()
    if facts["commit"] == "unknown":
        return ""
    changes = ", with changes" if facts["commit_dirty"] == "true" else ""
    return f",\n  note    = {{Commit {facts['commit']}{changes}}}"


def _list_sources(certificate: Certificate) -> list[str]:
    """Returns the BibTeX entries of the papers whose methods were used for a verdict."""
    sources = []
    if certificate.roots is not None and certificate.roots.verdict:
        sources.append(_ROOTS)
    if certificate.twins is not None and certificate.twins.pushes:
        sources.append(_PUSHES)
    if certificate.law_proofs:
        sources.append(_POSITION_EXCHANGE)
    if certificate.has_functional:
        sources.append(_THEOREM)
    return sources

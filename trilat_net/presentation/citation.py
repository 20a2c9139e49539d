"""Composes a paragraph for a paper about the stability of a run, with its references.

The paragraph names the scenario, the program, what the verdict rests on, and the numbers behind
it, so that a reader of the paper can repeat and judge the statement. References follow as
BibTeX entries.

Invariant:
    - The paragraph states nothing that the certificate does not state.
    - A source is listed only if the statement rests on it.
"""

from collections.abc import Iterator

from ..analysis import Certificate, Stability
from ..errors import count_nouns
from ..files import find_version
from ..log import Log

_SOFTWARE = """@software{{trilat_net,
  title   = {{trilat-net}},
  author  = {{{{The trilat-net authors}}}},
  version = {{{version}}},
  license = {{MIT}}
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
    """Yields a paragraph for a paper about a run, and then its references as BibTeX.

    The paragraph states the scenario, the judgement and its basis, and the program.

    Args:
        log: The log of the run.
        certificate: Judgement whether the run was stable, with its reasons.
    """
    yield " ".join(_compose_sentences(log, certificate))
    yield ""
    yield _SOFTWARE.format(version=find_version())
    for entry in _list_sources(certificate):
        yield ""
        yield entry


def _compose_sentences(log: Log, certificate: Certificate) -> Iterator[str]:
    """Yields the sentences of the paragraph."""
    scenario = log.scenario
    ticks = sum(len(log[site]) for site in log.sites)
    laws = ", ".join(dict.fromkeys(law.tag for law in scenario.controls))
    yield (
        f"The run of the scenario {scenario.name} (SHA-256 {scenario.sha256[:16]}, "
        f"{count_nouns(len(scenario.names), 'site')}, control law {laws}) was recorded with "
        f"{count_nouns(ticks, 'record')} and judged with trilat-net {find_version()} "
        "\\cite{trilat_net}."
    )
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


def _list_sources(certificate: Certificate) -> list[str]:
    """Returns the BibTeX entries of the methods on which a certificate rests."""
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

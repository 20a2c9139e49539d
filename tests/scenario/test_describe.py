from trilat_net.scenario import load_scenario
from trilat_net.scenario.describe import compare_scenarios


def told(*scenarios: tuple[str, list[str]]) -> dict[str, tuple[str, ...]]:
    return {
        str(one): one.values
        for one in compare_scenarios([load_scenario(name, sets) for name, sets in scenarios])
    }


def test_one_experiment_differs_in_nothing_whatever_it_is_called() -> None:
    assert told(("free", []), ("free", ["name=other", "expect.stable=false"])) == {}


def test_one_gain_of_all_sites_is_one_line_and_of_one_site_says_which() -> None:
    assert told(("free", []), ("free", ["control.Kd=5"])) == {"control.Kd of m1, m2, s": ("3", "5")}
    found = told(("free", []), ("free", ["sites.s.control.Kd=[5, 6]"]))
    assert found == {"control.Kd of s": ("3", "[5, 6]")}


def test_another_law_is_told_as_a_whole() -> None:
    found = told(("free", []), ("free", ["control.law=p_d"]))
    assert found == {
        "control of m1, m2, s": (
            "adaptive (Lambda 1, Kp 1, Kd 3, Gamma 1, theta_hat0 0)",
            "p_d (K 10, d 3, gravity 1)",
        )
    }


def test_links_are_told_in_words() -> None:
    found = told(("free", []), ("free", ["link.delay_ms=50"]), ("free", ["links.m1->s.delay_ms=9"]))
    assert found == {
        "link m1->s": ("200 ms", "50 ms", "9 ms"),
        "link m2->m1, s->m1, m1->m2, s->m2, m2->s": ("200 ms", "50 ms", "200 ms"),
    }


def test_other_scenarios_other_sites_other_hands() -> None:
    found = told(("contact", []), ("free", []))
    assert found["sites"] == ("m, s", "m1, m2, s")
    assert "wall" in found["environment of s"][0]
    assert found["environment of s"][1] == "none"
    assert found["duration_s"] == ("15", "30")

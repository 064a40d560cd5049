import numpy as np

from swarmtwin.standin.physics import fabricate

SPREADS = {"speed": 0.02, "track": 0.01}


def test_a_unit_is_the_same_whoever_else_drives():
    alone = fabricate("mgr", ["2"], SPREADS)
    among_others = fabricate("mgr", ["7", "2", "1"], SPREADS)
    for name, factor in alone.items():
        assert factor[0] == among_others[name][1]


def test_units_and_robots_differ():
    factors = fabricate("mgr", ["1", "2", "3"], SPREADS)["speed"]
    assert len(set(factors)) == 3
    assert fabricate("mur", ["1"], SPREADS)["speed"] != factors[0]


def test_no_unit_is_further_off_than_stated_and_together_they_centre_on_the_drawing():
    factors = fabricate("mgr", [str(number) for number in range(2000)], SPREADS)
    for name, spread in SPREADS.items():
        deviation = (factors[name] - 1) / spread
        assert np.abs(deviation).max() <= 2 + 1e-9
        assert abs(deviation.mean()) < 3.3 / np.sqrt(2000)  # 0.1 % of correct draws exceed it

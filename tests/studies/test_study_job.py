"""What decides a row."""

from __future__ import annotations

from dataclasses import replace


def test_seeds_do_not_depend_on_the_number_of_campaigns(job):
    seeds = [job.campaign_seed(i) for i in range(200)]
    assert len(set(seeds)) == 200 and all(0 <= s < 2**63 for s in seeds)
    assert replace(job, seed=8).campaign_seed(0) != seeds[0]

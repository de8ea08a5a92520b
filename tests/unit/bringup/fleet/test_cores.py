# SPDX-License-Identifier: Apache-2.0
"""Cores of surveys beside each other."""

from __future__ import annotations

import os

import pytest

pytest.importorskip("dask", reason="Dask is not installed: make setup FLEET=1")

from pipeprog_bringup.fleet import cores

FIRST = 10 * os.getpid()  # no core has this number, and no other process that runs these tests
MACHINE = {FIRST, FIRST + 1, FIRST + 2}


@pytest.fixture(autouse=True)
def three_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: MACHINE)
    monkeypatch.setattr(cores, "CPU_COUNT", 3)


def test_surveys_beside_each_other_have_different_cores() -> None:
    with cores.own_cores(1) as first, cores.own_cores(2) as second:
        assert (first, second) == ({FIRST}, {FIRST + 1, FIRST + 2})
    with cores.own_cores(3) as all_of_them:
        assert all_of_them == MACHINE, "those of surveys that are over are free again"


def test_where_fewer_are_free_a_survey_runs_on_all_and_holds_none() -> None:
    with cores.own_cores(2), cores.own_cores(2) as too_many:
        assert too_many == MACHINE
        with cores.own_cores(1) as last:
            assert last == {FIRST + 2}


def test_where_a_quota_gives_less_than_the_cores_none_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cores, "CPU_COUNT", 1)
    with cores.own_cores(1) as found:
        assert found == MACHINE

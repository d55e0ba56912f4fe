"""`zermelo plan --cluster`: the optima come from workers of a real Dask cluster."""

from pathlib import Path

import numpy as np
import pytest
from dask_cluster import DaskCluster

from ocp.query_family import PAPER_FIGURE_STARTS, paper_query
from sims.commands.plan import solve


def test_the_clusters_optima_are_those_found_here(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    query = paper_query((4.0, 4.0))
    starts = [np.array(s) for s in PAPER_FIGURE_STARTS[:2]]
    _, here = solve(query, starts, "eikonal")
    with DaskCluster(tmp_path, workers=1) as cluster:
        _, there = solve(query, starts, "eikonal", cluster=cluster.address)
    for a, b in zip(here, there, strict=True):
        assert a.exact is not None
        assert b.exact is not None
        assert b.exact.cost == pytest.approx(a.exact.cost, rel=1e-9)

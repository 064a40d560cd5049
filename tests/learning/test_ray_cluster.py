"""Jobs on a Ray cluster, here one on this machine."""

import os
import signal
from pathlib import Path

import pytest

from swarmtwin.errors import UserError
from swarmtwin.learning.ray_cluster import CalledFrom, run_on_cluster


@pytest.fixture(autouse=True)
def ray(request):
    if request.node.get_closest_marker("services"):
        pytest.importorskip("ray", reason="pip install 'swarmtwin[ray]'")


def test_a_machine_that_does_not_see_the_folder_is_told_of(tmp_path):
    with pytest.raises(UserError, match=r"^a machine of the cluster does not see .*nowhere: call the command where"):
        CalledFrom(tmp_path / "nowhere", {}).go()


def job(work):
    """A job that does something; its class goes to the cluster as it is written here."""

    class Job:
        def run(self, report):
            return work(report)

    return Job()


@pytest.mark.services
def test_results_are_in_order_and_reports_come_to_this_process(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SWARMTWIN_SAYS", "so")
    heard = []

    def work(number):
        def done(report):
            report(number, "began")
            report(number, "ended")
            return number, str(Path.cwd()), os.environ["SWARMTWIN_SAYS"]

        return job(done)

    results = run_on_cluster(
        [work(number) for number in range(3)], lambda *told: heard.append(told), None, "cluster=local"
    )
    assert results == [(number, str(tmp_path), "so") for number in range(3)]
    assert sorted(heard) == [(number, told) for number in range(3) for told in ("began", "ended")]
    assert heard[0][0] == heard[1][0]


@pytest.mark.services
def test_what_a_job_raises_is_raised_here():
    def fail(report):
        raise UserError("this recording has no rows")

    with pytest.raises(UserError, match=r"^this recording has no rows$") as raised:
        run_on_cluster([job(fail)], print, None, "cluster=local")
    assert "in fail" in str(raised.value.__cause__)  # where it was raised there


@pytest.mark.services
def test_a_job_that_is_lost_again_and_again_is_told_of():
    def die(report):
        os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(UserError, match=r"^cluster=local: a job was lost on the cluster: WorkerCrashedError"):
        run_on_cluster([job(die)], print, None, "cluster=local")


@pytest.mark.services
def test_a_cluster_that_is_not_there_is_told_of():
    with pytest.raises(UserError, match=r"^cluster=auto: no Ray cluster answers at auto"):
        run_on_cluster([job(print)], print, "auto", "cluster=auto")

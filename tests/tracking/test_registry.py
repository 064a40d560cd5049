import multiprocessing
import shutil
from pathlib import Path

import mlflow
import numpy as np
import pytest

from preloaded import run_forked
from swarmtwin.errors import UserError
from swarmtwin.tracking import registry
from swarmtwin.tracking.challengers import challenge_by_errors
from swarmtwin.tracking.datasets import files_digest
from swarmtwin.tracking.gate import Errors
from swarmtwin.tracking.model_source import model_folder
from swarmtwin.tracking.runs import tracked_run

NAME, POLICIES = "mgr-dynamics", "mgr-policy"
FORK = multiprocessing.get_context("fork")


@pytest.fixture
def publish(workplace, empty_store):
    """Register a model whose content is `text`, as a command that trained it would; let it challenge by its errors."""

    shutil.copy(empty_store, workplace)

    def register(text, name=NAME, errors=None, held_out="", **tags):
        folder = Path.cwd() / f"model_{text}"
        folder.mkdir(exist_ok=True)
        (folder / "model.yaml").write_text(text)
        with tracked_run("dynamics", text, {}) as run:
            source = run.folder(folder, "model")
            version = registry.register(name, folder, source, run.run_id, {"model": "mlp", **tags})
            return challenge_by_errors(run, version, errors, held_out) if errors else version

    return register


def champion(task=None):
    return registry.holder(NAME if task is None else POLICIES, "champion", task)


def test_versions_are_numbered_and_their_files_come_back(publish):
    first, second = publish("one"), publish("two")
    assert (first.number, second.number) == (1, 2)
    assert registry.find_version(f"models:/{NAME}/2").aliases == ()
    assert (model_folder(f"models:/{NAME}/1") / "model.yaml").read_text() == "one"
    assert registry.find_version(f"models:/{NAME}/1").tags["model"] == "mlp"
    assert champion() is None


def test_a_version_that_is_not_better_leaves_the_challenger_where_it_is(publish):
    answers = {"two": (False, "not measurably better"), "three": (True, "measurably better")}
    assert registry.challenge(publish("one"), None) == f"registered as {NAME} version 1, its challenger"
    said = [registry.challenge(publish(text), lambda _, answer=answers[text]: answer) for text in answers]
    assert said == [
        f"registered as {NAME} version 2; version 1 stays challenger: not measurably better",
        f"registered as {NAME} version 3, its challenger in place of version 1: measurably better",
    ]
    assert registry.holder(NAME, "challenger").number == 3


def test_a_challenger_that_came_meanwhile_is_compared_with_as_well(publish):
    first, second, third = publish("one"), publish("two"), publish("three")
    registry.challenge(first, None)
    compared = []

    def compare(challenger):
        compared.append(challenger.number)
        if challenger.number == 1:
            registry.challenge(second, lambda _: (True, "better than the first"))
        return challenger.number == 1, "better than the first alone"

    assert registry.challenge(third, compare).endswith("; version 2 stays challenger: better than the first alone")
    assert compared == [1, 2]
    assert registry.holder(NAME, "challenger").number == 2


def test_errors_on_the_same_held_out_runs_decide_who_challenges(publish):
    rng = np.random.default_rng(0)
    base = rng.gamma(4, 1, (20, 2))

    def challenge(text, factor, held_out="these", runs=20):
        error = factor * (base[:runs] + rng.normal(0, 0.05, (runs, 2)))
        return publish(text, errors=Errors(*error.T, np.full(runs, 30)), held_out=held_out)

    name = f"registered as {NAME} version"
    assert challenge("first", 1.0) == f"{name} 1, its challenger"
    assert challenge("worse", 1.1).startswith(f"{name} 2; version 1 stays challenger: one-step error +")
    assert challenge("equal", 1.0).endswith("not measurably better on the same held-out runs")
    better = challenge("better", 0.9)
    assert better.startswith(f"{name} 4, its challenger in place of version 1: one-step error -")
    assert better.endswith(": measurably better on the same held-out runs")
    assert challenge("elsewhere", 2.0, "others") == (
        f"{name} 5, its challenger in place of version 4: not compared, since the two were not measured on the same "
        "held-out runs"
    )
    assert challenge("few", 1.0, "few", 5).endswith("were not measured on the same held-out runs")
    assert challenge("few again", 2.0, "few", 5).endswith(
        "not compared (5 held-out runs are too few to judge by: record at least 6)"
    )


def test_policies_of_different_tasks_have_champions_challengers_and_histories_of_their_own(publish):
    def policy(text, task):
        return publish(text, POLICIES, task=task)

    for text, task in (("c1", "collective"), ("o1", "obstacle"), ("c2", "collective"), ("o2", "obstacle")):
        version = policy(text, task)
        registry.challenge(version, lambda _: (True, "better"))
        registry.promote(version, "better", champion(task))
    assert {v.number: v.aliases for v in registry.versions(POLICIES)} == {
        1: (),
        2: (),
        3: ("challenger", "champion"),
        4: ("challenger-obstacle", "champion-obstacle"),
    }
    assert [v.task for v in registry.holders(POLICIES, "champion")] == ["obstacle", "collective"]
    assert registry.roll_back(POLICIES, "collective") == (3, 1)
    assert (champion("collective").number, champion("obstacle").number) == (1, 4)
    with pytest.raises(UserError, match="version 1 is the first champion"):
        registry.roll_back(POLICIES, "collective")
    assert registry.roll_back(POLICIES, "obstacle") == (4, 2)


def test_the_champion_of_a_task_is_found_and_that_of_another_refused_with_the_right_reference(publish):
    for text, task in (("c", "collective"), ("o", "obstacle")):
        registry.promote(publish(text, POLICIES, task=task), "good", None)
    plain = f"models:/{POLICIES}@champion"
    assert registry.find_version(plain, "collective").number == 1
    assert registry.find_version(plain, "obstacle").number == 2
    with pytest.raises(UserError, match=r"write models:/mgr-policy@champion-obstacle$"):
        model_folder(f"models:/{POLICIES}/1", "obstacle")
    with pytest.raises(UserError, match=r"write models:/mgr-policy@champion$"):
        model_folder(f"{plain}-obstacle", "collective")
    with pytest.raises(UserError, match=r"not for 'pair': no policy for 'pair' is champion yet$"):
        model_folder(plain, "pair")


def test_a_copied_store_finds_its_files_beside_itself(publish, workplace, monkeypatch):
    registry.promote(publish("one"), "good", None)
    copy = workplace.with_name(f"{workplace.name}, copied")
    shutil.copytree(workplace, copy)
    shutil.rmtree(workplace / "mlruns")
    monkeypatch.chdir(copy)
    monkeypatch.delenv("MLFLOW_TRACKING_URI")  # MLflow sets it
    folder = model_folder(f"models:/{NAME}@champion")
    assert (folder / "model.yaml").read_text() == "one"
    assert folder.is_relative_to(copy)
    registry.promote(publish("two"), "better", champion())
    assert model_folder(f"models:/{NAME}@champion").is_relative_to(copy)
    assert not (workplace / "mlruns").exists()


def test_a_version_is_found_by_its_content(publish, workplace):
    publish("one")
    publish("two")
    assert registry.version_of(NAME, workplace / "model_one").number == 1
    (workplace / "model_one" / "model.yaml").write_text("changed")
    assert registry.version_of(NAME, workplace / "model_one") is None


def page_of(version):
    return mlflow.MlflowClient().get_model_version(version.name, str(version.number)).description


def test_what_a_person_wrote_on_a_page_stays_below_what_a_promotion_says(publish):
    first, second = publish("one"), publish("two")
    mlflow.MlflowClient().update_model_version(NAME, "1", "Wheels were changed.")
    for _ in range(2):
        registry.promote(first, "good", champion(), "It is good.")
        registry.promote(second, "better", champion())
    assert page_of(first) == "It is good.\n\n---\n\nWheels were changed."
    assert not page_of(second)
    registry.promote(first, "good", champion(), "It is better.")
    assert page_of(first) == "It is better.\n\n---\n\nIt is good.\n\n---\n\nWheels were changed."
    mlflow.MlflowClient().update_model_version(NAME, "2", "by hand " * 500)
    registry.promote(second, "good", champion(), "It is good.\n\n" + "long" * 400)
    assert page_of(second) == "It is good.\n\n---\n\n" + "by hand " * 500  # all of what was there


def test_champions_follow_each_other_and_roll_back_in_order(publish):
    for text in ("one", "two", "three"):
        registry.promote(publish(text), "better", champion())
    assert champion().number == 3
    assert registry.roll_back(NAME) == (3, 2)
    assert registry.roll_back(NAME) == (2, 1)
    assert champion().number == 1
    with pytest.raises(UserError, match="version 1 is the first champion: there is none to roll back to"):
        registry.roll_back(NAME)
    assert champion().number == 1


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("models:/mgr", "'models:/mgr' names no model: write models:/NAME@ALIAS or models:/NAME/VERSION"),
        ("models:/mur-dynamics/1", "no registered model 'mur-dynamics'; registered: mgr-dynamics"),
        ("models:/mgr-dynamics/7", "no such version; there are 1"),
        ("models:/mgr-dynamics@champion", "no such version; there are 1"),
        ("nowhere", "no model folder nowhere: give a folder, models:/NAME@ALIAS or models:/NAME/VERSION"),
    ],
)
def test_a_wrong_reference_says_what_there_is(publish, reference, message):
    publish("one")
    with pytest.raises(UserError) as error:
        model_folder(reference)
    assert message in str(error.value)


def test_a_version_whose_files_are_gone_is_not_blamed_on_the_store(publish):
    shutil.rmtree(publish("one").source.removeprefix("file://"))
    with pytest.raises(UserError, match=r"^the files of mgr-dynamics version 1 are not where .* says"):
        model_folder(f"models:/{NAME}/1")


def test_without_any_model_the_remedy_is_to_train_one(workplace):
    with pytest.raises(UserError, match="registered: none yet: train one first"):
        registry.find_version("models:/mgr-dynamics@champion")
    with pytest.raises(UserError, match="has no champion to roll back from"):
        registry.roll_back(NAME)


def test_files_that_were_changed_are_refused_with_both_digests(publish):
    version = publish("one")
    file = version.folder() / "model.yaml"
    file.write_text("two")
    with pytest.raises(UserError, match=r"version 1 in .* are not those that were registered: their digest is") as told:
        model_folder(f"models:/{NAME}/1")
    assert version.tags["files.digest"] in str(told.value)
    assert files_digest(file.parent) in str(told.value)
    file.write_text("one")
    assert model_folder(f"models:/{NAME}/1") == file.parent


def test_a_champion_that_was_not_compared_with_is_not_replaced(publish):
    first, second, third = publish("one"), publish("two"), publish("three")
    registry.promote(first, "the first", None)
    registry.promote(second, "better", first)
    with pytest.raises(UserError, match="version 2 became champion meanwhile: promote mgr-dynamics version 3 again"):
        registry.promote(third, "better than version 1", first)
    assert champion().number == 2


@pytest.mark.parametrize("change", ["promotion", "rollback"])
def test_a_kill_in_the_middle_of_a_change_of_champions_leaves_the_history_right(publish, monkeypatch, change):
    """Between what is remembered and who is champion: called again, the change is whole, and no champion is twice."""
    first, second, third = publish("one"), publish("two"), publish("three")
    registry.promote(first, "the first", None)
    registry.promote(second, "better", first)
    half = {"promotion": "set_registered_model_alias", "rollback": "set_registered_model_tag"}[change]
    with monkeypatch.context() as patch:
        patch.setattr(f"mlflow.MlflowClient.{half}", fail)
        with pytest.raises(KeyboardInterrupt):
            registry.promote(third, "best", second) if change == "promotion" else registry.roll_back(NAME)
    if change == "promotion":
        registry.promote(third, "best", second)
        assert registry.roll_back(NAME) == (3, 2)
        assert registry.roll_back(NAME) == (2, 1)
    assert champion().number == 1
    with pytest.raises(UserError, match="is the first champion"):
        registry.roll_back(NAME)


def fail(*arguments):
    raise KeyboardInterrupt


def promote_until_it_is_champion(number):
    """Be promoted against whoever is champion, again and again until that is still true."""
    version = registry.find_version(f"models:/{NAME}/{number}")
    while True:
        try:
            registry.promote(version, "better", champion())
            return
        except UserError as error:
            if "meanwhile" not in str(error):
                raise


def test_of_promotions_at_once_none_is_missing_in_the_history(publish):
    numbers = [publish(str(index)).number for index in range(6)]
    processes = [FORK.Process(target=promote_until_it_is_champion, args=(number,)) for number in numbers]
    _at_once(processes)
    passed = [champion().number]
    for _ in numbers[1:]:
        passed.append(registry.roll_back(NAME)[1])
    assert sorted(passed) == numbers
    with pytest.raises(UserError, match="is the first champion"):
        registry.roll_back(NAME)


def train_nothing(number, workplace):
    folder = workplace / f"model_{number}"
    folder.mkdir()
    (folder / "model.yaml").write_text(str(number))
    with tracked_run("dynamics", str(number), {"output": str(number)}) as run:
        run.metrics({"position_mm": number})
        source = run.folder(folder, "model")
    registry.register(NAME, folder, source, run.run_id, {})


def test_writers_on_a_new_database_all_succeed(workplace):
    _at_once([FORK.Process(target=train_nothing, args=(number, workplace)) for number in range(16)])
    assert sorted(version.number for version in registry.versions(NAME)) == list(range(1, 17))


def _at_once(processes):
    for process in processes:
        process.start()
    for process in processes:
        process.join(timeout=120)
    assert [process.exitcode for process in processes] == [0] * len(processes)


SMALL_DISK = """
import ctypes, os, subprocess
from pathlib import Path
NEW_USER, NEW_MOUNTS, NO_DISK = 0x10000000, 0x20000, 77
maps = {"setgroups": "deny", "uid_map": f"0 {os.getuid()} 1", "gid_map": f"0 {os.getgid()} 1"}
if ctypes.CDLL(None).unshare(NEW_USER | NEW_MOUNTS):
    os._exit(NO_DISK)
for name, content in maps.items():
    Path("/proc/self", name).write_text(content)
if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4M", "none", "disk"], capture_output=True).returncode:
    os._exit(NO_DISK)
os.chdir("disk")
"""
FULL_DISK = """
import logging, time
from swarmtwin.files import new_folder
from swarmtwin.tracking import registry
from swarmtwin.tracking.runs import tracked_run

logging.basicConfig(level=logging.WARNING)


def fill():
    with open("filler", "wb", buffering=0) as filler:
        for size in (65536, 4096, 1):
            try:
                while True:
                    filler.write(bytes(size))
            except OSError:
                pass


def learn(full):
    inside = new_folder(Path("out"), "train", resumable=True, overwrite=True)
    with inside as folder, tracked_run("dynamics", full, {"output": "out"}) as run:
        (folder / "checkpoints" / "seed-1").write_text("epoch 3")
        (folder / "model.yaml").write_text("a model" * 1000)
        if full == "files":
            fill()
        source = run.folder(folder, "model")
        if full == "registration":
            fill()
        version = registry.register("mgr-dynamics", folder, source, run.run_id, {})
        registry.challenge(version, lambda challenger: (True, "newer"))
        if full == "end":
            fill()


for full in ("files", "registration", "end"):
    started = time.monotonic()
    try:
        learn(full)
    except OSError as error:
        assert error.errno == 28, error
    else:
        raise AssertionError(full)
    assert time.monotonic() - started < 10
    assert Path(".out.partial/checkpoints/seed-1").exists()
    Path("filler").unlink()
    learn("room")
    assert sorted(path.name for path in Path("out").iterdir()) == ["model.yaml", "provenance.json"]
    for version in registry.versions("mgr-dynamics"):
        version.folder()
    assert registry.find_version("models:/mgr-dynamics@challenger").folder()
"""


def test_a_full_disk_in_the_middle_leaves_nothing_half_and_the_same_call_goes_on(workplace, capfd):
    """On a small file system of the test's own."""
    (workplace / "disk").mkdir()
    status = run_forked(SMALL_DISK + FULL_DISK)
    if status == 77:
        pytest.skip("no file system can be mounted here")
    error = capfd.readouterr().err
    assert status == 0, error
    assert "Traceback" not in error

import multiprocessing
import shutil

import pytest

from swarmtwin.errors import UserError
from swarmtwin.tracking import registry
from swarmtwin.tracking.datasets import files_digest
from swarmtwin.tracking.runs import tracked_run

NAME = "mgr-dynamics"
FORK = multiprocessing.get_context("fork")


@pytest.fixture
def publish(workplace):
    """Register a model whose content is `text`, as a command that trained it would."""

    def register(text):
        folder = workplace / f"model_{text}"
        folder.mkdir(exist_ok=True)
        (folder / "model.yaml").write_text(text)
        with tracked_run("dynamics", text, {}) as run:
            source = run.folder(folder, "model")
        return registry.register(NAME, folder, source, run.run_id, {"model": "mlp"})

    return register


def test_the_newest_version_is_the_challenger_and_its_files_come_back(publish):
    first, second = publish("one"), publish("two")
    assert (first.number, second.number) == (1, 2)
    assert registry.find_version(f"models:/{NAME}@challenger").number == 2
    assert (registry.model_folder(f"models:/{NAME}/1") / "model.yaml").read_text() == "one"
    assert registry.find_version(f"models:/{NAME}/1").tags["model"] == "mlp"
    assert registry.champion(NAME) is None


def test_a_version_is_found_by_its_content(publish, workplace):
    publish("one")
    publish("two")
    assert registry.version_of(NAME, workplace / "model_one").number == 1
    (workplace / "model_one" / "model.yaml").write_text("changed")
    assert registry.version_of(NAME, workplace / "model_one") is None


def test_champions_follow_each_other_and_roll_back_in_order(publish):
    for text in ("one", "two", "three"):
        registry.promote(publish(text), "better", registry.champion(NAME))
    assert registry.champion(NAME).number == 3
    assert registry.roll_back(NAME) == (3, 2)
    assert registry.roll_back(NAME) == (2, 1)
    assert registry.champion(NAME).number == 1
    with pytest.raises(UserError, match="version 1 is the first champion: there is none to roll back to"):
        registry.roll_back(NAME)
    assert registry.champion(NAME).number == 1


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("models:/mgr", "'models:/mgr' names no model: write models:/NAME@ALIAS or models:/NAME/VERSION"),
        ("models:/mur-dynamics/1", "no registered model 'mur-dynamics'; registered: mgr-dynamics"),
        ("models:/mgr-dynamics/7", "no such version; there are 1 (@challenger)"),
        ("models:/mgr-dynamics@champion", "no such version; there are 1 (@challenger)"),
        ("nowhere", "no model folder nowhere: give a folder, models:/NAME@ALIAS or models:/NAME/VERSION"),
    ],
)
def test_a_wrong_reference_says_what_there_is(publish, reference, message):
    publish("one")
    with pytest.raises(UserError) as error:
        registry.model_folder(reference)
    assert message in str(error.value)


def test_a_version_whose_files_are_gone_is_not_blamed_on_the_store(publish):
    shutil.rmtree(publish("one").source.removeprefix("file://"))
    with pytest.raises(UserError, match=r"^the files of mgr-dynamics version 1 are not where .* says"):
        registry.model_folder(f"models:/{NAME}/1")


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
        registry.model_folder(f"models:/{NAME}/1")
    assert version.tags["files.digest"] in str(told.value)
    assert files_digest(file.parent) in str(told.value)
    file.write_text("one")
    assert registry.model_folder(f"models:/{NAME}/1") == file.parent


def test_a_champion_that_was_not_compared_with_is_not_replaced(publish):
    first, second, third = publish("one"), publish("two"), publish("three")
    registry.promote(first, "the first", None)
    registry.promote(second, "better", first)
    with pytest.raises(UserError, match="version 2 became champion meanwhile: promote mgr-dynamics version 3 again"):
        registry.promote(third, "better than version 1", first)
    assert registry.champion(NAME).number == 2


def promote_until_it_is_champion(number):
    """Be promoted against whoever is champion, again and again until that is still true."""
    version = registry.find_version(f"models:/{NAME}/{number}")
    while True:
        try:
            registry.promote(version, "better", registry.champion(NAME))
            return
        except UserError as error:
            if "meanwhile" not in str(error):
                raise


def test_of_promotions_at_once_none_is_missing_in_the_history(publish):
    numbers = [publish(str(index)).number for index in range(12)]
    processes = [FORK.Process(target=promote_until_it_is_champion, args=(number,)) for number in numbers]
    _at_once(processes)
    passed = [registry.champion(NAME).number]
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

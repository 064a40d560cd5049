import shutil

import pytest

from swarmtwin.errors import UserError
from swarmtwin.tracking import registry
from swarmtwin.tracking.runs import tracked_run

NAME = "mgr-dynamics"


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
        registry.promote(publish(text), reason="better")
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

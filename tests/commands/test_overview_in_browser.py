"""The overview page, and the models' tables in it, as a person's browser shows them."""


def test_the_overview_loads_without_errors_and_fits(swarmtwin, model, workshop, browser):
    for name in ("kinematic", "mlp"):
        model(name, f"models/{name}")
    swarmtwin("prepare", "recording=reference", "output=artifacts/transitions/mgr")
    recordings = ("train_vehicle=reference", "other_vehicle=other_vehicle", "open_loop=open_loop")
    swarmtwin("experiment", "name=dynamics", "models=models", *recordings, "output=artifacts/comparison/mgr")
    assert swarmtwin("experiment", "name=overview", "robots=[mgr]", "output=overview").status == 0
    for width in (1280, 400):
        page = browser.open(workshop / "overview" / "overview.html", width)
        shown = page.text()
        for said in ("What the pipeline made", "Micro-Ground Robot (mgr)", "kinematic", "floor", "least error"):
            assert said in shown
        assert page.evaluate("document.images.length") >= 2
        assert page.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
        assert page.errors == []
        assert page.elsewhere() == []
        assert not page.is_wider_than_the_window()

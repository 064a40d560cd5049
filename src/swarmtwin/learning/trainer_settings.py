"""How Lightning trains: on what, with how many processes and digits, what is seen of it meanwhile, and when it ends."""

from typing import Annotated, Literal, NamedTuple, Self

from pydantic import Field, model_validator

from swarmtwin.learning.device import Device
from swarmtwin.robot import StrictModel

Count = Annotated[int, Field(ge=1)]


class TrainerSettings(StrictModel):
    """What is passed on to `lightning.Trainer`; `conf/trainer/default.yaml` says the same.

    Attributes:
        name: the file's name.
        device: where to train.
        processes: that train a seed together, each on its share of every batch.
        strategy: Lightning's, by which they do.
        precision: Lightning's.
        logger: whether the errors of each epoch arrive in the MLflow run while one process learns; those of the seed
            that becomes the model stand there in the end, in any case.
        system_metrics: whether the run shows how busy the machine is.
        progress_bar: what is seen in the terminal.
        checkpoint_epochs: so many epochs lie between two checkpoints.
        patience_epochs: end when the validation loss has not fallen for so many epochs; None: learn to the end.
    """

    name: str = "default"
    device: Device = "auto"
    processes: Count = 1
    strategy: Literal["auto", "ddp_fork", "ddp_spawn"] = "auto"
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    logger: Literal["mlflow", "none"] = "mlflow"
    system_metrics: bool = False
    progress_bar: Literal["epochs", "rich", "none"] = "epochs"
    checkpoint_epochs: Count = 1
    patience_epochs: Count | None = None

    @model_validator(mode="after")
    def _strategy_of_several(self) -> Self:
        if self.processes > 1 and self.strategy == "auto":
            raise ValueError("processes=2 and more want a strategy: trainer=ddp_cpu, or trainer.strategy=ddp_spawn")
        return self


class LiveCurves(NamedTuple):
    """The MLflow run that errors are sent to while a model learns.

    Attributes:
        run_id: the run.
        store: where it is kept.
    """

    run_id: str
    store: str

"""TD3 whose actor learns half as often."""

from typing import Literal

from swarmtwin.policies.algorithms import td3


class Config(td3.Config):
    """`conf/policy/patient_td3.yaml`."""

    name: Literal["patient_td3"]
    policy_delay: int = 4

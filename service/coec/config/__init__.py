"""Everything a user may set, with its default, unit and reason: one frozen model per stage, unknown keys refused.

`load_config` reads the one YAML file of a daemon. The command line uses the same stage models (`WindowConfig`,
`CalibrationConfig`, ...), so that each default exists once. Import from this package, not from its modules.
"""

from coec.config.authority import AuthorityConfig, SenderConfig
from coec.config.base import IDENTITY, FilePath, Matrix4x4, Name, describe
from coec.config.decisions import MonitorConfig, PolicyConfig
from coec.config.links import LinkConfig
from coec.config.metrics import MetricsConfig, is_loopback
from coec.config.pair import OpenPairConfig, PairConfig
from coec.config.reading import config_of, load_config
from coec.config.ros import RosConfig, RosOutput
from coec.config.service import (
    BudgetConfig,
    LidarEdgesConfig,
    LimitsConfig,
    LogConfig,
    SnippetsConfig,
    StateConfig,
    WorkerConfig,
    ZenohConfig,
)
from coec.config.stages import (
    MAX_SLICE_S,
    CalibrationConfig,
    DepthConfig,
    ObjectiveConfig,
    PairingConfig,
    SearchConfig,
    TimeOffsetConfig,
    TrackerConfig,
    VerdictConfig,
    WindowConfig,
)
from coec.config.streams import (
    AnyStreamConfig,
    CameraConfig,
    CameraIntrinsics,
    CameraMessage,
    EgoConfig,
    EgoMessage,
    KnownStreamConfig,
    LidarConfig,
    LidarMessage,
    OpenEgoConfig,
    OpenLidarConfig,
    PointTimeConfig,
    StreamConfig,
    SweepConfig,
    TimeBase,
    TimeUnit,
    TopicName,
)
from coec.config.uplink import UplinkConfig
from coec.config.whole import Config, config_hash
from coec.config.yaml_text import MAX_YAML_BYTES, load_yaml, parse_yaml

__all__ = [
    "IDENTITY",
    "MAX_SLICE_S",
    "MAX_YAML_BYTES",
    "AnyStreamConfig",
    "AuthorityConfig",
    "BudgetConfig",
    "CalibrationConfig",
    "CameraConfig",
    "CameraIntrinsics",
    "CameraMessage",
    "Config",
    "DepthConfig",
    "EgoConfig",
    "EgoMessage",
    "FilePath",
    "KnownStreamConfig",
    "LidarConfig",
    "LidarEdgesConfig",
    "LidarMessage",
    "LimitsConfig",
    "LinkConfig",
    "LogConfig",
    "Matrix4x4",
    "MetricsConfig",
    "MonitorConfig",
    "Name",
    "ObjectiveConfig",
    "OpenEgoConfig",
    "OpenLidarConfig",
    "OpenPairConfig",
    "PairConfig",
    "PairingConfig",
    "PointTimeConfig",
    "PolicyConfig",
    "RosConfig",
    "RosOutput",
    "SearchConfig",
    "SenderConfig",
    "SnippetsConfig",
    "StateConfig",
    "StreamConfig",
    "SweepConfig",
    "TimeBase",
    "TimeOffsetConfig",
    "TimeUnit",
    "TopicName",
    "TrackerConfig",
    "UplinkConfig",
    "VerdictConfig",
    "WindowConfig",
    "WorkerConfig",
    "ZenohConfig",
    "config_hash",
    "config_of",
    "describe",
    "is_loopback",
    "load_config",
    "load_yaml",
    "parse_yaml",
]

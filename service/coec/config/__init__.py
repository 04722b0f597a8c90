"""Everything a user may set, with its default, unit and reason: one frozen model per stage, unknown keys refused.

`load_config` reads the one YAML file of a daemon. The command line uses the same stage models (`WindowConfig`,
`CalibrationConfig`, ...), so that each default exists once. Import from this package, not from its modules.
"""

from coec.config.model import IDENTITY, FilePath, Matrix4x4, Name, describe
from coec.config.pair import (
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
    OpenPairConfig,
    PacketMessage,
    PairConfig,
    PointTimeConfig,
    StreamConfig,
    SweepConfig,
    TimeBase,
    TimeUnit,
    TopicName,
)
from coec.config.rig import LinkConfig
from coec.config.root import MAX_YAML_BYTES, Config, config_hash, config_of, load_config, load_yaml, parse_yaml
from coec.config.service import (
    AuthorityConfig,
    BudgetConfig,
    LidarEdgesConfig,
    LimitsConfig,
    LogConfig,
    MetricsConfig,
    RosConfig,
    RosOutput,
    SenderConfig,
    SnippetsConfig,
    StateConfig,
    UplinkConfig,
    WorkerConfig,
    ZenohConfig,
    is_loopback,
)
from coec.config.stages import (
    MAX_SLICE_S,
    CalibrationConfig,
    DepthConfig,
    MonitorConfig,
    ObjectiveConfig,
    PairingConfig,
    PolicyConfig,
    SearchConfig,
    TimeOffsetConfig,
    TrackerConfig,
    VerdictConfig,
    WindowConfig,
)

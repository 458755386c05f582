"""The models that cross the wire: what the service, the SDK, the worker and the viewer agree on.

SI units and radians; degrees only where a name ends in ``_deg``. Quaternions are xyzw. A grasp is the
pose of the tool frame in the object frame: origin midway between the fingers, z the approach, y the
closing direction. Requests forbid unknown fields; responses may grow, so clients ignore what they do
not know.
"""

from graspdb.wire import reports as reports
from graspdb.wire.base import OUTCOME_CODES as OUTCOME_CODES
from graspdb.wire.base import OUTCOMES as OUTCOMES
from graspdb.wire.base import SOURCES as SOURCES
from graspdb.wire.base import FieldError as FieldError
from graspdb.wire.base import Outcome as Outcome
from graspdb.wire.base import Page as Page
from graspdb.wire.base import Pose as Pose
from graspdb.wire.base import Problem as Problem
from graspdb.wire.base import Request as Request
from graspdb.wire.base import Response as Response
from graspdb.wire.base import Slug as Slug
from graspdb.wire.base import Source as Source
from graspdb.wire.grippers import Finger as Finger
from graspdb.wire.grippers import GripperCreate as GripperCreate
from graspdb.wire.grippers import GripperInfo as GripperInfo
from graspdb.wire.grippers import GripperProfile as GripperProfile
from graspdb.wire.jobs import ClaimedJob as ClaimedJob
from graspdb.wire.jobs import ClaimRequest as ClaimRequest
from graspdb.wire.jobs import ClaimResponse as ClaimResponse
from graspdb.wire.jobs import DecomposePayload as DecomposePayload
from graspdb.wire.jobs import FailureReport as FailureReport
from graspdb.wire.jobs import GridPlan as GridPlan
from graspdb.wire.jobs import LeaseRenewed as LeaseRenewed
from graspdb.wire.jobs import PosePlan as PosePlan
from graspdb.wire.jobs import ResultAccepted as ResultAccepted
from graspdb.wire.jobs import ResultRows as ResultRows
from graspdb.wire.jobs import SimulatePayload as SimulatePayload
from graspdb.wire.jobs import SimulateResult as SimulateResult
from graspdb.wire.jobs import WorkerInfo as WorkerInfo
from graspdb.wire.kernels import KernelComponent as KernelComponent
from graspdb.wire.kernels import KernelCreate as KernelCreate
from graspdb.wire.kernels import KernelProvenance as KernelProvenance
from graspdb.wire.kernels import KernelWidths as KernelWidths
from graspdb.wire.kernels import KernelWindow as KernelWindow
from graspdb.wire.kernels import StoredKernel as StoredKernel
from graspdb.wire.objects import BoundingBox as BoundingBox
from graspdb.wire.objects import MeshInfo as MeshInfo
from graspdb.wire.objects import ObjectCreate as ObjectCreate
from graspdb.wire.objects import ObjectInfo as ObjectInfo
from graspdb.wire.objects import ObjectPatch as ObjectPatch
from graspdb.wire.objects import PartsInfo as PartsInfo
from graspdb.wire.queries import BestGraspRequest as BestGraspRequest
from graspdb.wire.queries import BestGrasps as BestGrasps
from graspdb.wire.queries import DensityInfo as DensityInfo
from graspdb.wire.queries import Grasp as Grasp
from graspdb.wire.queries import GraspConstraints as GraspConstraints
from graspdb.wire.queries import Interval as Interval
from graspdb.wire.queries import Intervals as Intervals
from graspdb.wire.queries import KernelInfo as KernelInfo
from graspdb.wire.queries import KernelSpec as KernelSpec
from graspdb.wire.queries import LikelihoodRequest as LikelihoodRequest
from graspdb.wire.queries import Likelihoods as Likelihoods
from graspdb.wire.queries import ObstacleBox as ObstacleBox
from graspdb.wire.queries import Obstacles as Obstacles
from graspdb.wire.queries import PoseColumns as PoseColumns
from graspdb.wire.queries import Proposals as Proposals
from graspdb.wire.queries import ProposalsRequest as ProposalsRequest
from graspdb.wire.queries import Ranking as Ranking
from graspdb.wire.queries import Samples as Samples
from graspdb.wire.queries import SamplesRequest as SamplesRequest
from graspdb.wire.queries import Selection as Selection
from graspdb.wire.queries import WeightsInfo as WeightsInfo
from graspdb.wire.queries import WorldPose as WorldPose
from graspdb.wire.sweeps import GridSpec as GridSpec
from graspdb.wire.sweeps import Region as Region
from graspdb.wire.sweeps import SampleSpec as SampleSpec
from graspdb.wire.sweeps import SweepCreate as SweepCreate
from graspdb.wire.sweeps import SweepInfo as SweepInfo
from graspdb.wire.sweeps import SweepOutcomes as SweepOutcomes
from graspdb.wire.trials import BatchInfo as BatchInfo
from graspdb.wire.trials import BatchReceipt as BatchReceipt
from graspdb.wire.trials import Finding as Finding
from graspdb.wire.trials import TrialChange as TrialChange
from graspdb.wire.trials import TrialColumns as TrialColumns
from graspdb.wire.trials import TrialIn as TrialIn
from graspdb.wire.trials import TrialInfo as TrialInfo
from graspdb.wire.trials import TrialOut as TrialOut
from graspdb.wire.trials import TrialPatch as TrialPatch
from graspdb.wire.trials import TrialsIn as TrialsIn

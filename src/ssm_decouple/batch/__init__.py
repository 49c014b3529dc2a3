"""Many configurations and many motions of one robot at once: `Batch`, and `JaxBatch` for GPUs and gradients."""

from ssm_decouple.batch.accelerated import JaxBatch as JaxBatch
from ssm_decouple.batch.accelerated import TracedCommand as TracedCommand
from ssm_decouple.batch.accelerated import TracedLaw as TracedLaw
from ssm_decouple.batch.accelerated import TracedMotion as TracedMotion
from ssm_decouple.batch.engine import Batch as Batch
from ssm_decouple.batch.results import Commands as Commands
from ssm_decouple.batch.results import Matrices as Matrices
from ssm_decouple.batch.results import Motions as Motions

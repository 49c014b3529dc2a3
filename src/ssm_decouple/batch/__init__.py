"""Many configurations and many motions of one robot at once: `Batch`."""

from ssm_decouple.batch.engine import Batch as Batch
from ssm_decouple.batch.results import Commands as Commands
from ssm_decouple.batch.results import Matrices as Matrices
from ssm_decouple.batch.results import Motions as Motions

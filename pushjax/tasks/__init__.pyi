from .environment import Environment as Environment
from .environment import FiveValues as FiveValues
from .environment import TaskParams as TaskParams
from .environment import TaskState as TaskState
from .push_t import PushT as PushT
from .push_t import PushTParams as PushTParams
from .spaces import Box as Box
from .spaces import Dict as Dict

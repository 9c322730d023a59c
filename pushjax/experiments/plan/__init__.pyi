from .experiment import run as run
from .experiment import summary as summary
from .options import Options as Options

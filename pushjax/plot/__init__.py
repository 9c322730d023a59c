"""Pictures: of single pushes and tables (`figures`), of distributions (`distributions`), of errors (`causes`), of what
accuracy costs (`speed`)."""

from pushjax.plot.causes import causes_figure as causes_figure
from pushjax.plot.distributions import density_panel as density_panel
from pushjax.plot.distributions import histogram_panel as histogram_panel
from pushjax.plot.distributions import pose_panel as pose_panel
from pushjax.plot.distributions import spread_figure as spread_figure
from pushjax.plot.distributions import traces as traces
from pushjax.plot.figures import BETWEEN as BETWEEN
from pushjax.plot.figures import BLUE as BLUE
from pushjax.plot.figures import END as END
from pushjax.plot.figures import GREEN as GREEN
from pushjax.plot.figures import MM as MM
from pushjax.plot.figures import ORANGE as ORANGE
from pushjax.plot.figures import PURPLE as PURPLE
from pushjax.plot.figures import START as START
from pushjax.plot.figures import STYLE as STYLE
from pushjax.plot.figures import grasp_figure as grasp_figure
from pushjax.plot.figures import hand_at as hand_at
from pushjax.plot.figures import jam_figure as jam_figure
from pushjax.plot.figures import legend_below as legend_below
from pushjax.plot.figures import limit_surfaces as limit_surfaces
from pushjax.plot.figures import motion_cone_figure as motion_cone_figure
from pushjax.plot.figures import outline as outline
from pushjax.plot.figures import push_figure as push_figure
from pushjax.plot.figures import save as save
from pushjax.plot.figures import table_figure as table_figure
from pushjax.plot.speed import speed_figure as speed_figure

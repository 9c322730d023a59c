"""Figures and animations, in mm and degrees, in colors that color-blind readers can tell apart.

A function `..._figure` makes a whole figure. `animate` and `animate_cloud` make an animation. `save` writes either to a
file. A function `..._panel` draws into given axes, and so do the parts of pictures: `outline`, `hand_at` and `traces`.
"""

from pushjax.plot.animation import animate as animate
from pushjax.plot.animation import animate_cloud as animate_cloud
from pushjax.plot.clouds import capture_figure as capture_figure
from pushjax.plot.clouds import cloud_figure as cloud_figure
from pushjax.plot.contacts import jam_figure as jam_figure
from pushjax.plot.contacts import motion_cone_figure as motion_cone_figure
from pushjax.plot.distributions import density_panel as density_panel
from pushjax.plot.distributions import histogram_panel as histogram_panel
from pushjax.plot.distributions import pose_panel as pose_panel
from pushjax.plot.distributions import traces as traces
from pushjax.plot.files import save as save
from pushjax.plot.forces import ContactForces as ContactForces
from pushjax.plot.forces import contact_forces as contact_forces
from pushjax.plot.motion import Animation as Animation
from pushjax.plot.parts import hand_at as hand_at
from pushjax.plot.parts import outline as outline
from pushjax.plot.pushes import RealPush as RealPush
from pushjax.plot.pushes import grasp_figure as grasp_figure
from pushjax.plot.pushes import push_figure as push_figure
from pushjax.plot.pushes import real_figure as real_figure
from pushjax.plot.style import BLACK as BLACK
from pushjax.plot.style import BLUE as BLUE
from pushjax.plot.style import GRAY as GRAY
from pushjax.plot.style import GREEN as GREEN
from pushjax.plot.style import MM as MM
from pushjax.plot.style import ORANGE as ORANGE
from pushjax.plot.style import PURPLE as PURPLE
from pushjax.plot.style import RED as RED
from pushjax.plot.style import STYLE as STYLE
from pushjax.plot.style import legend_below as legend_below
from pushjax.plot.surfaces import limit_surfaces as limit_surfaces
from pushjax.plot.tables import table_figure as table_figure
from pushjax.plot.tracks import RecordedPush as RecordedPush

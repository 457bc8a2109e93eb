"""The worlds by their options."""

from slam.simulation.options import SimulationOptions
from slam.simulation.rooms import SimulatedRooms
from slam.simulation.street import SimulatedStreet
from slam.simulation.world import SimulatedWorld


def simulated_world(options: SimulationOptions) -> SimulatedWorld:
    """The street or the rooms of these options.

    Raises:
        SequenceError: there are too few frames for the route.
    """
    return SimulatedRooms(options) if options.route == "rooms" else SimulatedStreet(options)

"""A rehearsal's picture on the link."""

from rehearsal.coordinates import probe_in_patient
from rehearsal.rehearsal import Rehearsal
from rehearsal.tracking.openigtlink_messages import LivePicture
from rehearsal.tracking.openigtlink_server import Server
from render.viewer import View
from ultrasound.probe import Probe


def send_live(link: Server | None, rehearsal: Rehearsal, view: View, probe: Probe, time_s: float) -> None:
    """Send the first picture of a view that was taken just now with a probe as it is set, where there is a link."""
    if link is not None:
        grey = next(iter(view.pictures.values()))
        pixels = probe.image_to_probe(*grey.shape)
        link.show(LivePicture(grey, pixels, probe_in_patient(rehearsal), time_s))

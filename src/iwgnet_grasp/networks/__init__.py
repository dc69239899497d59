"""Networks by name. Imports neither ROS nor the C++ extension."""

from collections.abc import Callable

from iwgnet_grasp.networks.ggcnn import GGCNN, GGCNN2
from iwgnet_grasp.networks.grasp_network import GraspMaps, GraspNetwork, count_parameters
from iwgnet_grasp.networks.grconvnet import GRConvNet
from iwgnet_grasp.networks.iwgnet import IWGNet

GRASP_NETWORKS: dict[str, Callable[[], GraspNetwork]] = {
    "iwgnet": IWGNet,
    "iwgnet-noinception": lambda: IWGNet(inception=False),
    "iwgnet-nowff": lambda: IWGNet(weighted_fusion=False),
    "ggcnn": GGCNN,
    "ggcnn2": GGCNN2,
    "grconvnet": GRConvNet,
}


def create_network(name: str) -> GraspNetwork:
    """A new network with random weights. ValueError names the known ones."""
    if name not in GRASP_NETWORKS:
        raise ValueError(f"no grasp network '{name}'; known: {', '.join(GRASP_NETWORKS)}")
    return GRASP_NETWORKS[name]()


__all__ = ["GRASP_NETWORKS", "GraspMaps", "GraspNetwork", "count_parameters", "create_network"]

"""
One instance of a node at a time.

Two supervisors, or two estimators, on one set of topics would take turns with the
robot. A lock file names the holder at once on the same computer and goes with its
process, however that ends; a node on another computer is seen in the ROS graph.
"""

from rclpy.node import Node

from beetle_omni_ros.nodes.private import HeldError, Lock


class StartError(RuntimeError):
    """A node cannot start or go on; the text is one line for the operator."""


def claim(node: Node):
    """
    Take the node's lock until it is closed, or the process ends.

    Raises:
        StartError: another process of this computer holds it.

    """
    domain = node.context.get_domain_id()
    name = node.get_fully_qualified_name()
    try:
        return Lock(f"{domain}{name.replace('/', '.')}.lock")
    except HeldError as error:
        raise StartError(f'{name} runs already (process {str(error) or "unknown"}, ROS domain '
                         f'{domain}); stop it first') from None
    except OSError as error:    # the graph check still stands
        node.get_logger().warning(f'a second {name} on this computer may go unnoticed: {error}')
        return None


def refuse_twin(node: Node) -> None:
    """
    Look for a node of the same name elsewhere in the ROS graph.

    Raises:
        StartError: there is one.

    """
    own = (node.get_name(), node.get_namespace())
    if node.get_node_names_and_namespaces().count(own) > 1:
        raise StartError(f'{node.get_fully_qualified_name()} runs already on another computer '
                         f'(ROS domain {node.context.get_domain_id()}); stop it first')

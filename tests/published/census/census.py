from neuros.hooks import neuros_initialise


@neuros_initialise(outputs="start")
def look_around(node):
    logger = node.get_ros_node().get_logger()
    for topic in node.get_topic_list():
        if topic.endswith("/data"):
            logger.info(f"found {topic}")
            logger.info(node.get_topic_info(topic).splitlines()[0])
    return node.make_packet()

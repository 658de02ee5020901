"""Answers each image with the sum of its bytes."""

from neuros.hooks import neuros_function


@neuros_function(inputs="image", outputs="seen")
def look(node, image):
    answer = node.make_packet("seen")
    answer.data = sum(image.data)
    return answer

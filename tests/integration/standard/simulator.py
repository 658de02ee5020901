"""The simulator of the example, which does in its third step what the variable ``FAULT`` says."""

import os
import sys

sys.path.insert(0, os.environ["EXAMPLE"])

import outside_simulator
from simulation_interfaces.msg import Result

FAULT = os.environ["FAULT"]


class Simulator(outside_simulator.Simulator):
    calls = 0

    def on_step(self, request, response):
        self.calls += 1
        if self.calls < 3:
            return super().on_step(request, response)
        if FAULT == "dies":
            os._exit(1)
        if FAULT == "leaves":
            raise KeyboardInterrupt
        if FAULT == "steps less":
            request.steps -= 1
            return super().on_step(request, response)
        response.result.result = Result.RESULT_OPERATION_FAILED
        response.result.error_message = "the solver has diverged"
        return response

    def on_features(self, request, response):
        if FAULT != "lacks features":
            super().on_features(request, response)
        return response


if __name__ == "__main__":
    outside_simulator.main(Simulator)

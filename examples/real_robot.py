"""Learn the swing-up on a robot that this program reaches by a socket, and by nothing else.

The robot is `simulated_robot.py`, in another process.  Of a real one only `send` and `receive`
would differ.  Messages take 20 to 50 ms each way, so up to two torques are on their way when the
next one is chosen.  They are part of the state: without them the motion could not be predicted.
"""

import argparse
import json

from simulated_robot import Clock, started

import kreps

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--folder", default="runs/robot", help="of the session; it goes on there")
parser.add_argument("--updates", type=int, default=13, help="in all; 13 need some 5,000 cycles")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--speed", type=float, default=1.0, help="simulated seconds per second")
args = parser.parse_args()

task = kreps.TaskSpec(
    observation_size=4, action_low=[-30.0], action_high=[30.0], periodic=(0,), dt=0.05
)
learner = kreps.KREPS(task, seed=args.seed, initial_rollouts=10)
with started(args.speed) as (_, link):
    lines = link.makefile()

    def send(**message: float) -> None:
        link.sendall(json.dumps(message).encode() + b"\n")

    def receive() -> list[float]:
        return json.loads(lines.readline())

    session = learner.session(
        args.folder,
        stop=lambda action: send(torque=action.item()),
        watchdog=4,  # periods: the first answer takes one and the way there and back
        clock=Clock(args.speed),
    )
    with session as robot:
        for rollout in robot.rollouts(args.updates):
            send(reset=rollout.seed)
            while (message := receive())[0] != 0:  # those of the rollout before
                pass
            sent = [0.0, 0.0]  # N m, the newest first
            torque = robot.act([*message[1:], *sent]).item()
            while robot.running:
                send(torque=torque)
                _, angle, velocity = message
                robot.reward(-10.0 * angle**2 - 0.1 * velocity**2 - 1e-3 * torque**2)
                sent = [torque, sent[0]]
                message = receive()
                torque = robot.act([*message[1:], *sent]).item()
            send(torque=robot.stop_action.item())
        print(f"{robot.missed_deadlines} actions came more than half a period late")

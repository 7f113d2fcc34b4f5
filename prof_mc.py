import cProfile,pstats,gymnasium as gym,kreps,sys
from kreps.threads import blas_threads
l=kreps.KREPS(gym.make(sys.argv[1]),seed=int(sys.argv[2])); pr=cProfile.Profile()
with blas_threads(1):
    pr.enable(); l.learn(10**6,progress=False,callback=lambda l,r: l.state.steps<8000); pr.disable()
pstats.Stats(pr).sort_stats("cumtime").print_stats(48)

from t8 import *

t.close()
seeds = [11, 12, 13]
T = make_task("DoraCube-v1", 3)
for sc in (1.0, 0.2):
    st = sc * (2 * torch.rand(12, 3, 26, generator=g) - 1)
    A = run(T, seeds, st)
    for i in range(2):
        S = make_task("DoraCube-v1", 1, sim_backend="physx_cpu")
        B_ = run(S, [seeds[i]], st[:, i : i + 1])
        d = B_[:, 0] - A[:, i]
        print(sc, i, [round(x, 6) for x in d.abs().amax(-1).tolist()], names(S, d[:4]))
        S.close()

import time, json, sys, os
import torch, torchdeform as td
from torchdeform.registration.deformable import register
from torchdeform.registration.settings import RegistrationSettings
def load(n):
    d,s,h,o,r=torch.load(f".carry/{n}.pt"); return td.Image(d, td.Grid(s,h), o, r, n)
def blobs(shape, seed):
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(1,1,*[s//8 for s in shape], generator=g)
    return torch.nn.functional.interpolate(x, size=shape, mode="trilinear", align_corners=True)
def timed(name, f, m, **kw):
    for device in ("cuda","cpu"):
        if device=="cpu" and kw.pop("nocpu", False): continue
        a,b=f.to(device),m.to(device)
        runs=3 if device=="cuda" else 1
        ts=[]
        for _ in range(runs):
            t=time.perf_counter(); r=td.register(a,b); 
            if device=="cuda": torch.cuda.synchronize()
            ts.append(round(time.perf_counter()-t,2))
        mem=torch.cuda.max_memory_allocated()/2**20 if device=="cuda" else 0
        if device=="cuda": ref=r.displacement.cpu()
        else: print(name, "difference cuda cpu, voxel: max", float((ref-r.displacement).abs().max()), "mean", float((ref-r.displacement).abs().mean()), flush=True)
        print(name, device, "s", ts, "MiB", round(mem), "similarity", float(r.similarity_after), "folds", float(r.diagnosis.min_determinant) if hasattr(r,"diagnosis") and hasattr(r.diagnosis,"min_determinant") else "", {k: round(v,2) for k,v in r.seconds.items()}, flush=True)
print(torch.__version__, torch.cuda.get_device_name())
timed("hippocampus", load("hippocampus_001"), load("hippocampus_003"))
timed("mouse", load("mouse1"), load("mouse2"))

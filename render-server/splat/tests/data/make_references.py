#!/usr/bin/env python3
"""Creates the small scenes of this folder, and their images by the float64 numpy oracle.

    python3 make_references.py ORACLE.py

ORACLE.py is an independent module that needs only numpy, with `load_ply(path)` and `render(splats, camera)`
as described in tests/images/oracle.rs. Writes sh0 to sh3: .ply (INRIA layout), and for cameras a and b of each:
_a.json (camera) and _a.npz (rgb, alpha, depth, depth_median; float32, rounded). For camera a it also writes
_a_antialiased.npz: the image if the scene was trained with anti-aliasing. Results are equal on all machines.
"""
import importlib.util
import json
import pathlib
import sys

import numpy as np

# Width, height. One is much wider than high, so that tiles are cut on both sides.
SIZES = dict(a=(64, 48), b=(80, 36))


def scene(rng, degree, count):
    """Returns some large flat splats in the background and many small ones in front, with all opacities."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    large = count // 5
    xyz = np.concatenate([rng.uniform([-3, -2, 4], [3, 2, 7], (large, 3)),
                          rng.uniform([-1.5, -1.1, 0.6], [1.5, 1.1, 4], (count - large, 3))])
    log_scale = np.log(np.concatenate([rng.uniform(0.05, 1.2, (large, 3)),
                                       np.exp(rng.uniform(np.log(0.004), np.log(0.25), (count - large, 3)))]))
    quat = rng.normal(size=(count, 4)) * rng.uniform(0.5, 2, (count, 1))
    logit = rng.uniform(-6, 7, (count, 1))
    dc = rng.uniform(-1.7, 1.7, (count, 3))
    sh = rng.normal(size=(count, rest)) * 0.25
    return np.concatenate([xyz, np.zeros((count, 3)), dc, sh, logit, log_scale, quat], 1).astype('<f4')


def write_ply(path, rows, degree):
    rest = 3 * ((degree + 1) ** 2 - 1)
    names = ['x', 'y', 'z', 'nx', 'ny', 'nz'] + [f'f_dc_{i}' for i in range(3)] + [f'f_rest_{i}' for i in range(rest)]
    names += ['opacity'] + [f'scale_{i}' for i in range(3)] + [f'rot_{i}' for i in range(4)]
    head = f'ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n'
    head += ''.join(f'property float {n}\n' for n in names) + 'end_header\n'
    path.write_bytes(head.encode() + rows.tobytes())


def camera(degree, which):
    """Returns a camera with an off-centre principal point, unequal focal lengths, rotation about all axes, and a
    background. `a` is in front of the scene; `b` is wide and within the scene, surrounded by splats."""
    a, b, c = 0.05 + 0.07 * degree, -0.12 + 0.08 * degree, 0.1 * degree
    (w, h), f, shift = SIZES[which], 1.0, [0.1 * degree, -0.05, 0.3 - 0.2 * degree]
    if which == 'b':
        a, b, c, f, shift = -a, 0.5 - b, 1.5 - c, 0.55, [-0.2, 0.1 * degree, -1.6 - 0.3 * degree]
    rx = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    rz = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    w2c = np.eye(4)
    w2c[:3, :3] = rz @ ry @ rx
    w2c[:3, 3] = shift
    return dict(fx=(0.7 + 0.04 * degree) * w * f, fy=0.75 * w * f, cx=w / 2 + 3.25 * degree,
                cy=h / 2 - 1.5 * degree, w=w, h=h, bg=[0.1, 0.2, 0.3], w2c=w2c.tolist())


def rounded(name, v):
    """Rounds colour and alpha to 1/4096 (83 dB), depth to 12 bits (at most 1.2e-4), so that they compress well."""
    if name.startswith('depth'):
        mantissa, exponent = np.frexp(v)
        return np.ldexp(np.round(mantissa * 4096) / 4096, exponent).astype('<f4')
    return (np.round(v * 4096) / 4096).astype('<f4')


def antialiased(project, blur=0.3):
    """Returns the oracle's projection, with each opacity multiplied by the square root of the ratio of the
    determinants without and with the pixel's blur, at least 0: gsplat's rasterize_mode="antialiased"."""
    def compensated(splats, cam, *args, **kwargs):
        p = project(splats, cam, *args, **kwargs)
        a, b, c = p['conic'].T                    # the inverse of the blurred covariance
        blurred = 1 / (a * c - b * b)
        xx, xy, yy = c * blurred - blur, -b * blurred, a * blurred - blur
        return dict(p, op=p['op'] * np.sqrt(np.maximum((xx * yy - xy * xy) / blurred, 0)))
    return compensated


def save(view, image):
    np.savez_compressed(view.with_suffix('.npz'),
                        **{k: rounded(k, image[k]) for k in ('rgb', 'alpha', 'depth', 'depth_median')})
    print(view.name, 'visible', image['n_visible'], 'mean alpha %.3f' % image['alpha'].mean(),
          'splats per pixel %.1f' % image['n_contrib'].mean())


def main():
    spec = importlib.util.spec_from_file_location('oracle', sys.argv[1])
    oracle = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(oracle)
    here = pathlib.Path(__file__).parent
    for degree, count in enumerate([400, 250, 150, 100]):
        name = here / f'sh{degree}'
        write_ply(name.with_suffix('.ply'), scene(np.random.default_rng(100 + degree), degree, count), degree)
        splats = oracle.load_ply(str(name.with_suffix('.ply')))
        for which in SIZES:
            cam = camera(degree, which)
            view = here / f'sh{degree}_{which}'
            view.with_suffix('.json').write_text(json.dumps(cam) + '\n')
            image = oracle.render(splats, cam)
            save(view, image)
            if which == 'a':
                project, oracle.project = oracle.project, antialiased(oracle.project)
                save(view.with_name(view.name + '_antialiased'), oracle.render(splats, cam))
                oracle.project = project


main()

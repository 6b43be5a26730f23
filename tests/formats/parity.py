#!/usr/bin/env python3
"""Compares the scene formats of this project with those of other tools, for reading and writing.

    parity.py --tools DIR [--keep DIR] CONVERT

DIR holds venv/ and node_modules/ (tests/formats/run installs them); CONVERT is the example program of this project. For
every tool, format and degree of harmonics there are up to two comparisons: "we read theirs" (they write the known
scene, we convert it to PLY) and "they read ours" (we write it, they convert it to PLY). Splats are matched by position
and must agree within the format's resolution. Prints one line for each comparison; the last line has the number of
passed ones. --keep copies the files written by the tools and the known scenes; the fixtures of
render-server/splat/tests/data/formats were made this way.
"""
import argparse
import json
import pathlib
import shutil
import subprocess
import sys
import tempfile

import numpy as np

C0 = 0.28209479177387814
COLOUR = 1 / 255 / C0   # one step of a colour byte, as a harmonic


# --- scenes as dictionaries of arrays: mean, log_scale, wxyz, opacity (0..1), sh [n, k, 3]

def known(degree, count, seed):
    """Returns splats far enough apart to be distinguished, with values that no format clamps."""
    rng = np.random.default_rng(seed)
    cells = rng.permutation(14 ** 3)[:count]
    mean = np.stack([cells // 196, cells // 14 % 14, cells % 14], 1) * 0.5 - 3.25
    wxyz = rng.normal(size=(count, 4))
    return dict(mean=mean + rng.uniform(-0.15, 0.15, (count, 3)),
                log_scale=rng.uniform(-5, -2.5, (count, 3)),
                wxyz=wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True),
                opacity=rng.uniform(0.02, 0.98, count),
                sh=np.concatenate([rng.uniform(-1.5, 1.5, (count, 1, 3)),
                                   rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2 - 1, 3))], 1))


def write_ply(path, scene):
    count, coefficients, _ = scene['sh'].shape
    rest = 3 * (coefficients - 1)
    names = ['x', 'y', 'z', 'nx', 'ny', 'nz', 'f_dc_0', 'f_dc_1', 'f_dc_2']
    names += [f'f_rest_{i}' for i in range(rest)]
    names += ['opacity', 'scale_0', 'scale_1', 'scale_2', 'rot_0', 'rot_1', 'rot_2', 'rot_3']
    opacity = scene['opacity'][:, None]
    rows = np.concatenate([scene['mean'], np.zeros((count, 3)), scene['sh'][:, 0],
                           scene['sh'][:, 1:].transpose(0, 2, 1).reshape(count, rest),
                           np.log(opacity / (1 - opacity)), scene['log_scale'], scene['wxyz']], 1)
    head = f'ply\nformat binary_little_endian 1.0\nelement vertex {count}\n'
    head += ''.join(f'property float {name}\n' for name in names) + 'end_header\n'
    path.write_bytes(head.encode() + rows.astype('<f4').tobytes())


def read_ply(path):
    """Reads a plain binary PLY of float columns, in any order."""
    data = path.read_bytes()
    end = data.index(b'end_header\n') + 11
    lines = [line.split() for line in data[:end].decode().splitlines()]
    elements = [line for line in lines if line and line[0] == 'element']
    assert len(elements) == 1 and elements[0][1] == 'vertex', f'{path}: elements {elements}'
    types = {'float': '<f4', 'float32': '<f4', 'double': '<f8', 'uchar': 'u1', 'uint8': 'u1'}
    kind = np.dtype([(line[2], types[line[1]]) for line in lines if line and line[0] == 'property'])
    rows = np.frombuffer(data, kind, int(elements[0][2]), end)
    columns = lambda *names: np.stack([rows[name].astype(float) for name in names], 1)
    count = sum(name.startswith('f_rest_') for name in kind.names)
    rest = np.zeros((len(rows), 0, 3))
    if count:
        rest = columns(*[f'f_rest_{i}' for i in range(count)]).reshape(len(rows), 3, -1).transpose(0, 2, 1)
    wxyz = columns('rot_0', 'rot_1', 'rot_2', 'rot_3')
    return dict(mean=columns('x', 'y', 'z'), log_scale=columns('scale_0', 'scale_1', 'scale_2'),
                wxyz=wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True),
                opacity=1 / (1 + np.exp(-rows['opacity'].astype(float))),
                sh=np.concatenate([columns('f_dc_0', 'f_dc_1', 'f_dc_2')[:, None], rest], 1))


def turned(scene):
    """Returns the scene rotated by a half turn about x: y and z change sign. This converts between SPZ's axes (right,
    up, back) and the PLY's (right, down, forward). A harmonic of degree l, order m changes sign as its polynomial in x,
    y, z does."""
    odd = np.array([0, 1, 1, 0, 1, 0, 0, 1, 0, 1, 0, 1, 1, 0, 1, 0][:scene['sh'].shape[1]])
    return dict(scene, mean=scene['mean'] * [1, -1, -1], wxyz=scene['wxyz'] * [1, 1, -1, -1],
                sh=scene['sh'] * (1 - 2 * odd)[None, :, None])


# --- tolerances of a format: of positions [m], log scales, rotations [rad], opacity, colour, harmonics. Whole steps,
# not halves: some writers truncate and others round.

LOSS = {
    'compressed.ply': (6.9 / 1023, 2.5 / 1023, 0.01, 1 / 255, COLOUR, 1 / 32),
    'splat': (1e-6, 1e-5, 0.03, 1 / 255, COLOUR, 0),
    # Version 2 stores three bytes of the quaternion, and w follows from them: inaccurate near half a turn.
    'spz2': (1 / 4096, 1 / 16, 0.30, 1 / 255, 1 / 255 / 0.15, 1 / 8),
    'spz3': (1 / 4096, 1 / 16, 0.01, 1 / 255, 1 / 255 / 0.15, 1 / 8),
    'spz4': (1 / 4096, 1 / 16, 0.01, 1 / 255, 1 / 255 / 0.15, 1 / 8),
    # 65535 steps of the logarithm, coarsest at the far end; codebooks of 256 values.
    'sog': (4.4 * 2 * 1.5 / 65535, 0.05, 0.04, 1 / 255, 0.06, 0.03),
    'ksplat0': (1e-6, 1e-5, 1e-3, 1 / 255, COLOUR, 1e-6),
    'ksplat1': (5 / 65535, 2e-3, 3e-3, 1 / 255, COLOUR, 1e-3),
    'ksplat2': (5 / 65535, 2e-3, 3e-3, 1 / 255, COLOUR, 1.8 / 255),
    'glb': (1e-6, 1e-5, 1e-3, 1e-6, 1e-6, 1e-5),
    # Two readers of one file.
    'same': (1e-5, 1e-5, 1e-5, 1e-5, 1e-5, 1e-5),
}
PARTS = ('position', 'log scale', 'rotation', 'opacity', 'colour', 'harmonics')


def errors(truth, found, degree):
    """Returns the largest error of each part; splats are matched one to one by position."""
    if len(truth['mean']) != len(found['mean']):
        raise ValueError(f"{len(found['mean'])} splats instead of {len(truth['mean'])}")
    distance = np.linalg.norm(truth['mean'][:, None] - found['mean'][None], axis=2)
    match = distance.argmin(1)
    if len(set(match)) != len(match):
        raise ValueError('positions do not match one to one')
    f = {name: values[match] for name, values in found.items()}
    kept = (degree + 1) ** 2
    if f['sh'].shape[1] != kept:
        raise ValueError(f"{f['sh'].shape[1]} coefficients instead of {kept}")
    cosine = np.abs((truth['wxyz'] * f['wxyz']).sum(1)).clip(0, 1)
    most = lambda a: float(np.abs(a).max(initial=0))
    return (most(truth['mean'] - f['mean']), most(truth['log_scale'] - f['log_scale']),
            most(2 * np.arccos(cosine)), most(truth['opacity'] - f['opacity']),
            most(truth['sh'][:, 0] - f['sh'][:, 0]), most(truth['sh'][:, 1:kept] - f['sh'][:, 1:]))


# --- tools: name -> (formats written, formats read), each a function of (from, to)

def run(*command):
    result = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    if result.returncode:
        raise RuntimeError((result.stderr or result.stdout).strip()[-300:])


def tools(folder):
    modules = folder / 'node_modules'

    def splat_transform(*options):
        cli = modules / '@playcanvas/splat-transform/bin/cli.mjs'
        return lambda a, b: run('node', cli, '-q', '-w', '-g', 'cpu', *options, a, b)

    def gaussforge(given, wanted, version=3):
        def convert(a, b):
            import gaussforge
            result = gaussforge.GaussForge().convert(a.read_bytes(), given, wanted, spz_version=version)
            if 'error' in result:
                raise RuntimeError(result['error'])
            b.write_bytes(result['data'])
        return convert

    def gsply_write(a, b):
        import gsply
        data = gsply.plyread(str(a))
        gsply.plywrite(str(b), data, compressed=b.name.endswith('.compressed.ply'))

    def gsply_spz(version):
        def convert(a, b):
            import gsply
            gsply.write_spz(str(b), gsply.plyread(str(a)), version=version)
        return convert

    def gsply_unspz(a, b):
        import gsply
        gsply.plywrite(str(b), gsply.read_spz(str(a)))

    def kellogg_write(level, degree):
        return lambda a, b: run('node', pathlib.Path(__file__).with_name('ksplat.mjs'), modules,
                                'write', a, b, level, degree)

    def kellogg_read(a, b):
        rows = b.with_suffix('.json')
        run('node', pathlib.Path(__file__).with_name('ksplat.mjs'), modules, 'read', a, rows)
        v = np.array(json.loads(rows.read_text()))
        # Colours and opacities are bytes; the library has no access to single harmonics.
        write_ply(b, dict(mean=v[:, :3], log_scale=np.log(v[:, 3:6]), wxyz=v[:, 6:10],
                          opacity=(v[:, 13] / 255).clip(1e-6, 1 - 1e-6),
                          sh=((v[:, 10:13] / 255 - 0.5) / C0)[:, None]))

    spz_js = lambda a, b: run('node', pathlib.Path(__file__).with_name('spz.mjs'), modules, a, b)
    npm = lambda name: json.loads((modules / name / 'package.json').read_text())['version']
    from importlib.metadata import version as pip

    # Tool, format, degrees, their writer, their reader, and a peculiarity of the tool:
    # "axes": it copies the PLY's axes into SPZ, whose axes are right, up, back; so its input is the
    #   rotated scene, and its output is rotated back.
    # "same": it writes this format wrongly (its own reader and the others' disagree), so our reading
    #   of its file is compared with splat-transform's reading of the same file.
    reference = splat_transform()
    name = f"splat-transform {npm('@playcanvas/splat-transform')}"
    for kind in ('compressed.ply', 'sog'):
        yield name, kind, range(4), splat_transform(), reference, ''
    yield name, 'spz2', range(4), None, reference, ''
    for version in (3, 4):
        yield name, f'spz{version}', range(4), splat_transform('--spz-version', version), reference, ''
    # Writes glTF, but does not read it.
    yield name, 'glb', range(4), splat_transform(), None, ''
    yield name, 'splat', range(1), None, reference, ''
    for level in (0, 1, 2):
        yield name, f'ksplat{level}', range(3), None, reference, ''
    name = f"gaussforge {pip('gaussforge')}"
    for kind, degrees in (('splat', range(1)), ('sog', range(4))):
        yield name, kind, degrees, gaussforge('ply', kind), gaussforge(kind, 'ply'), ''
    both = gaussforge('ply', 'compressed.ply'), gaussforge('compressed.ply', 'ply')
    yield name, 'compressed.ply', range(1), *both, ''
    # Its order of harmonics differs from the other writers' and readers'.
    yield name, 'compressed.ply', range(1, 4), None, both[1], ''
    yield name, 'compressed.ply', range(1, 4), both[0], None, 'same'
    for version in (2, 3, 4):
        yield (name, f'spz{version}', range(4), gaussforge('ply', 'spz', version),
               gaussforge('spz', 'ply'), 'axes')
    # Does not read the levels with buckets, not even from the viewer's own library.
    yield name, 'ksplat0', range(2), gaussforge('ply', 'ksplat'), gaussforge('ksplat', 'ply'), ''
    yield name, 'ksplat0', range(2, 3), gaussforge('ply', 'ksplat'), None, 'same'
    name = f"gaussian-splats-3d {npm('@mkkellogg/gaussian-splats-3d')}"
    for level in (0, 1, 2):
        for degree in range(3):
            # The library has no access to single harmonics.
            yield (name, f'ksplat{level}', [degree], kellogg_write(level, degree),
                   None if degree else kellogg_read, '')
    name = f"gsply {pip('gsply')}"
    yield name, 'compressed.ply', range(4), gsply_write, gsply_write, ''
    for version in (3, 4):
        yield name, f'spz{version}', range(4), gsply_spz(version), gsply_unspz, 'axes'
    ply2splat = lambda a, b: run(folder / 'venv/bin/ply2splat', '-i', a, '-o', b)
    yield f"ply2splat {pip('ply2splat')}", 'splat', range(1), ply2splat, None, ''
    sogpy = lambda a, b: run(folder / 'venv/bin/sogpy', a, b)
    yield f"sogpy {pip('sogpy')}", 'sog', range(1), sogpy, None, ''
    # Its palette differs from the scene's harmonics for every reader.
    yield f"sogpy {pip('sogpy')}", 'sog', range(1, 4), sogpy, None, 'same'
    name = f"spz-js {npm('spz-js')}"
    yield name, 'spz2', range(4), spz_js, spz_js, 'axes'


def main():
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--tools', type=pathlib.Path, required=True)
    parser.add_argument('--keep', type=pathlib.Path)
    parser.add_argument('--count', type=int, help='splats of every scene')
    parser.add_argument('--only', default='', help='part of "tool format"')
    parser.add_argument('vizflyt', type=pathlib.Path)
    args = parser.parse_args()
    folder = args.tools.resolve()
    vizflyt = args.vizflyt.resolve()
    passed = failed = 0
    with tempfile.TemporaryDirectory() as temporary:
        scratch = pathlib.Path(temporary)

        def compare(tool, kind, degree, way, truth, make, loss):
            nonlocal passed, failed
            label = f'{tool:24} {kind:15} degree {degree}  {way:18}'
            try:
                worst = errors(truth(), make(), degree)
                over = [f'{part} {e:.2g} > {limit:.2g}'
                        for part, e, limit in zip(PARTS, worst, loss) if not e <= limit]
                figures = ', '.join(f'{part} {e:.2g}' for part, e in zip(PARTS, worst))
                failure = '; '.join(over)
            except Exception as error: # a tool's own failure is a result as well
                figures, failure = '', f'{type(error).__name__}: {error}'
            passed, failed = passed + (not failure), failed + bool(failure)
            print(f"{'FAIL' if failure else 'ok  '} {label} {failure or figures}", flush=True)

        for tool, kind, degrees, writer, reader, note in tools(folder):
            if args.only not in f'{tool} {kind}':
                continue
            extension = kind.rstrip('0123456789')
            variant = ['--variant', kind[-1]] if kind[-1].isdigit() else []
            turn = turned if note == 'axes' else lambda scene: scene
            for degree in degrees:
                # The palettes keep every splat's harmonics at these sizes; sogpy's smallest palette is 1024.
                count = 600 if kind != 'sog' else 1024 if 'sogpy' in tool else 256
                truth = known(degree, args.count or count, 7 + degree)
                source, given = scratch / f'known{degree}.ply', scratch / f'given{degree}.ply'
                write_ply(source, truth)
                write_ply(given, turn(truth))
                theirs = scratch / f'theirs{degree}.{extension}'
                ours = scratch / f'ours{degree}.{extension}'
                out, judge = scratch / 'out.ply', scratch / 'judge.ply'

                def read_theirs():
                    writer(given, theirs)
                    if args.keep:
                        stem = f"{tool.split()[0]}-{kind.replace('.', '-')}-sh{degree}"
                        shutil.copy(theirs, args.keep / f'{stem}.{extension}')
                        shutil.copy(source, args.keep / f'known-sh{degree}.ply')
                    run(vizflyt, 'scene', 'convert', theirs, out)
                    return read_ply(out)

                def they_read():
                    run(vizflyt, 'scene', 'convert', source, ours, *variant)
                    reader(ours, out)
                    return turn(read_ply(out))

                def judged():
                    writer(given, theirs)
                    run('node', folder / 'node_modules/@playcanvas/splat-transform/bin/cli.mjs',
                        '-q', '-w', theirs, judge)
                    return read_ply(judge)

                if writer and note == 'same':
                    compare(tool, kind, degree, 'as splat-transform', judged, read_theirs,
                            LOSS['same'])
                elif writer:
                    compare(tool, kind, degree, 'we read theirs', lambda: truth, read_theirs,
                            LOSS[kind])
                if reader:
                    compare(tool, kind, degree, 'they read ours', lambda: truth, they_read,
                            LOSS[kind])
    print(f'{passed} passed, {failed} failed')
    return failed > 0 or passed == 0


if __name__ == '__main__':
    sys.exit(main())

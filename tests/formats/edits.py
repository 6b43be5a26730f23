#!/usr/bin/env python3
"""Compares edits of scenes by `vizflyt scene edit` with those of splat-transform, for operations that both have.

    edits.py --tools DIR VIZFLYT

DIR holds node_modules/ (tests/formats/run installs it). Both rotate, scale, move and crop scenes of known splats with
every degree of harmonics; the results are matched splat by splat. splat-transform edits in its own axes, a half turn
about z from the file's: x and y change sign. Prints one line for each edit; the last line has the number of passed
comparisons.
"""
import argparse
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
from parity import errors, known, read_ply, write_ply

# A few roundings of f32; rotated harmonics are sums of up to seven products.
LOSS = (2e-6, 2e-6, 1e-5, 1e-6, 1e-6, 2e-6)
PARTS = ('position', 'log scale', 'rotation', 'opacity', 'colour', 'harmonics')

# Name, our steps, their actions, maximum number of the 600 splats in the result.
EDITS = [
    ('move', ['--move', '-1,-2,3'], ['-t', '1,2,3'], (600, 600)),
    ('turn about x', ['--rotate', '-90,0,0'], ['-r', '90,0,0'], (600, 600)),
    ('turn about all axes', ['--rotate', '-30,-40,50'], ['-r', '30,40,50'], (600, 600)),
    ('scale', ['--scale', '2.5'], ['-s', '2.5'], (600, 600)),
    ('crop to a box', ['--crop-box', '-2,-1.5,-1:1,2,3'], ['--filter-box=-1,-2,-1,2,1.5,3'], (20, 400)),
    ('crop to a ball', ['--crop-sphere', '-0.5,0.3,1:2.2'], ['--filter-sphere=0.5,-0.3,1,2.2'], (20, 400)),
    ('drop the faint', ['--min-opacity', '0.5'], ['-V', 'opacity,gte,0.5'], (200, 400)),
    ('all in turn', ['--crop-sphere', '-0.5,0.3,1:2.2', '--rotate', '0,-70,0', '--scale', '0.3', '--move', '0,-4,0'],
     ['--filter-sphere=0.5,-0.3,1,2.2', '-r', '0,70,0', '-s', '0.3', '-t', '0,4,0'], (20, 400)),
]


def run(*command):
    result = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    if result.returncode:
        raise RuntimeError((result.stderr or result.stdout).strip()[-300:])


def main():
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--tools', type=pathlib.Path, required=True)
    parser.add_argument('vizflyt', type=pathlib.Path)
    args = parser.parse_args()
    cli = args.tools.resolve() / 'node_modules/@playcanvas/splat-transform/bin/cli.mjs'
    passed = failed = 0
    with tempfile.TemporaryDirectory() as temporary:
        scratch = pathlib.Path(temporary)
        for name, ours, theirs, (least, most) in EDITS:
            for degree in range(4):
                source, edited, judged = (scratch / f'{n}{degree}.ply' for n in ('known', 'ours', 'theirs'))
                write_ply(source, known(degree, 600, 11 + degree))
                (scratch / f'{source.name}.edits.toml').unlink(missing_ok=True)
                figures = ''
                try:
                    run(args.vizflyt.resolve(), 'scene', 'edit', source, *ours, '-o', edited)
                    run('node', cli, '-q', '-w', source, *theirs, judged)
                    truth, found = read_ply(judged), read_ply(edited)
                    worst = errors(truth, found, degree)
                    judgements = zip(PARTS, worst, LOSS)
                    over = [f'{part} {e:.2g} > {limit:.2g}' for part, e, limit in judgements if not e <= limit]
                    if not least <= len(found['mean']) <= most:
                        over.append(f"{len(found['mean'])} splats left")
                    wanted, given = (np.argsort(scene['opacity'], kind='stable') for scene in (truth, found))
                    if not np.array_equal(wanted, given):
                        over.append('another order')
                    failure = '; '.join(over)
                    figures = ', '.join(f'{part} {e:.2g}' for part, e in zip(PARTS, worst))
                except Exception as error: # a tool's own failure is a result as well
                    failure = f'{type(error).__name__}: {error}'
                passed, failed = passed + (not failure), failed + bool(failure)
                print(f"{'FAIL' if failure else 'ok  '} {name:20} degree {degree}  {failure or figures}", flush=True)
    print(f'{passed} edits agree with splat-transform, {failed} do not')
    return failed > 0 or passed == 0


if __name__ == '__main__':
    sys.exit(main())

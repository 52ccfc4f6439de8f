// Builds the page of `evaluate people` into ../sfms_robot/viewer/people/. With --check: says whether what is there is what
// src/ gives.

import { build } from 'esbuild';
import { cpSync, existsSync, mkdtempSync, readFileSync, readdirSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { dirname, join } from 'node:path';
import { fileURLToPath } from 'node:url';

const here = dirname(fileURLToPath(import.meta.url));
const target = join(here, '..', 'sfms_robot', 'viewer', 'people');
const check = process.argv.includes('--check');
const folder = check ? mkdtempSync(join(tmpdir(), 'people-')) : target;

const common = { absWorkingDir: here, outdir: folder, minify: true, target: 'es2022', legalComments: 'none', logLevel: 'warning' };
await build({ ...common, entryPoints: ['src/people.js'], bundle: true, format: 'esm' });
await build({ ...common, entryPoints: ['src/people.css'] });
cpSync(join(here, 'src', 'people.html'), join(folder, 'index.html'));
if (check) {
  const differ = readdirSync(folder).filter((name) => !existsSync(join(target, name)) || !readFileSync(join(folder, name)).equals(readFileSync(join(target, name))));
  rmSync(folder, { recursive: true });
  if (differ.length) {
    console.error(`sfms_robot/viewer/people is not what src/ gives: ${differ.join(', ')}; node build-people.mjs`);
    process.exit(1);
  }
}

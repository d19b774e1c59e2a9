// Prints what the Khronos validator says about a file. Arguments: FILE.
import { readFileSync } from 'node:fs';
import validator from 'gltf-validator';

const report = await validator.validateBytes(new Uint8Array(readFileSync(process.argv[2])), { maxIssues: 100 });
console.log(JSON.stringify({ issues: report.issues, info: report.info }));

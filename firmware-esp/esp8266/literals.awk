# LLVM writes a function's `.literal` lines before its `.section` line, so GNU as would assign them to the previous
# section. This script holds them back until the section is known. With -mtext-section-literals they then lie next to
# the code that loads them, within reach of l32r.
/^\t\.literal_position$/ || /^\t\.literal / { held = held $0 "\n"; next }
/^\t\.section\t\.text/ || /^\t\.text$/ { print; next }
held != "" && /^\t\.p2align/ { printf "%s", held; held = ""; print; next }
{ print }
END { if (held != "") { print "literals without a section" > "/dev/stderr"; exit 1 } }

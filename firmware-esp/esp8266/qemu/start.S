/* Start and exception vectors for QEMU's lx106. Only for the emulator: the chip starts in its ROM and in the
 * vendor's SDK. */

    .section .reset, "ax"
    .global _start
_start:
    j       begin
    .align  4
    .literal_position
begin:
    movi    a0, 0
    wsr     a0, ps          /* not in an exception, interrupts at level 0 */
    isync
    movi    a1, _stack_top
    movi    a2, _stack_bottom
    movi    a3, 0xA5A5A5A5  /* paint the stack, to measure its depth later */
1:  s32i    a3, a2, 0
    addi    a2, a2, 4
    bltu    a2, a1, 1b
    movi    a2, _bss_start
    movi    a4, _bss_end
    movi    a3, 0
2:  bgeu    a2, a4, 3f
    s32i    a3, a2, 0
    addi    a2, a2, 4
    j       2b
3:  movi    a0, main
    callx0  a0
4:  j       4b

/* Exceptions stop the emulator with a distinct status: 0x60 + the vector's number. A load from the constants'
 * addresses calls constant_load (constants.c) instead. Vector offsets of the lx106: debug 0x10, NMI 0x20,
 * kernel 0x30, user 0x50, double 0x70. */
    .macro  vector offset, status
    .org    \offset
    movi    a2, 1
    movi    a3, \status
    simcall
    .endm

    .section .vectors, "ax"
    vector  0x10, 0x61
    vector  0x20, 0x62
    .org    0x30
    wsr     a2, excsave1
    j       load
    vector  0x50, 0x65
    vector  0x70, 0x67

    /* Save the registers to an array, a0 first, then sar; call constant_load. */
    .align  4
    .literal_position
load:
    movi    a2, constant_registers
    s32i    a0, a2, 0
    s32i    a1, a2, 4
    rsr     a0, excsave1
    s32i    a0, a2, 8
    .irp    n, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15
    s32i    a\n, a2, 4 * \n
    .endr
    rsr     a0, sar
    s32i    a0, a2, 64
    rsr     a3, epc1
    rsr     a4, excvaddr
    movi    a1, constant_stack_top
    movi    a0, constant_load
    callx0  a0              /* returns the address to continue at */
    wsr     a2, epc1
    movi    a2, constant_registers
    l32i    a0, a2, 64
    wsr     a0, sar
    .irp    n, 0, 1, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15
    l32i    a\n, a2, 4 * \n
    .endr
    l32i    a2, a2, 8
    rfe

    .section .text.simcall, "ax"
    /* int simcall(int number, int a, int b, int c): stores the error number in simcall_error. */
    .literal_position
    .global simcall
    .align  4
simcall:
    simcall
    movi    a4, simcall_error
    s32i    a3, a4, 0
    ret

    .section .text.cycles, "ax"
    .global cycles
    .align  4
cycles:
    rsr     a2, ccount
    ret

    .section .text.platform_interrupts, "ax"
    .global platform_interrupts_off
    .align  4
platform_interrupts_off:
    rsil    a2, 15
    ret
    .global platform_interrupts_restore
    .align  4
platform_interrupts_restore:
    wsr     a2, ps
    rsync
    ret
